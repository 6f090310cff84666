# The short way to the commands. `make help` lists the targets; every command also stands alone (`grasp-train --help`).
SIZE ?= 10k
TASK ?= regular
OUT ?= data/$(TASK)-$(SIZE)
SEED ?= 0
TORCH_INDEX ?=
TEST_WORKERS ?= 2
BENCH ?=
HOURS ?= 3
PLAN ?= studies/plans/10k.toml
FAULTS ?=

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
EXTRAS := sim,ray,dev
QUICK := runs/quickstart
QUICK_STEPS := 800
export PYTHONUNBUFFERED := 1

.PHONY: help setup quickstart test faults soak python-versions lint types data bench study clean

help: ## this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 17

setup: $(STAMP) ## make .venv and install everything into it

$(STAMP): pyproject.toml constraints.txt
	@set -e; \
	if [ ! -x $(BIN)/python ]; then \
	  fits='import sys, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))'; \
	  for python in python3 python3.11 python3.12 python3.13; do \
	    if $$python -c "$$fits" >/dev/null 2>&1; then $$python -m venv $(VENV); break; fi; \
	  done; \
	  if [ ! -x $(BIN)/python ] && command -v uv >/dev/null; then uv venv --seed --python 3.11 $(VENV); fi; \
	  if [ ! -x $(BIN)/python ]; then echo "Python 3.11, 3.12 or 3.13 is needed: install one with its venv module, or uv" >&2; exit 2; fi; \
	fi
	$(BIN)/python -m pip install -q --disable-pip-version-check -c constraints.txt pip setuptools wheel
	$(if $(TORCH_INDEX),$(BIN)/python -m pip install -q --disable-pip-version-check --index-url $(TORCH_INDEX) -c constraints.txt torch)
	$(BIN)/python -m pip install -q --disable-pip-version-check --no-build-isolation -c constraints.txt -e '.[$(EXTRAS)]'
	@touch $@

data: setup ## collect SIZE=10k|100k|1M grasps [TASK=regular|targeted] [WORKERS=n] [SEED=n] [OUT=folder]
	$(BIN)/grasp-datagen --task '$(TASK)' --size '$(SIZE)' --seed '$(SEED)' --out '$(OUT)' $(if $(WORKERS),--workers '$(WORKERS)')

quickstart: setup ## the whole job, small: objects, 7,000 grasps, dql trained and scored, a report (5 minutes)
	$(BIN)/grasp-datagen --size 7000 --out data/quickstart
	$(BIN)/grasp-train --algo dql --shards data/quickstart --steps $(QUICK_STEPS) --save-every 100 --out $(QUICK)/dql
	$(BIN)/grasp-eval $(QUICK)/dql --policy random --episodes 200 --out $(QUICK)/evaluations
	$(BIN)/grasp-report $(QUICK) --out $(QUICK)/report.html
	@echo "open $(QUICK)/report.html"

bench: setup ## every published ratio: results/bench.json and the table in RESULTS.md (about two hours; goes on where it was stopped)
	$(if $(wildcard data/regular-10k/manifest.json),,$(BIN)/grasp-datagen --size 10k --out data/regular-10k)
	$(if $(wildcard runs/mc-regular-10k-seed0/config.json),,$(BIN)/grasp-train --algo mc --shards data/regular-10k)
	$(BIN)/python benchmarks/bench.py $(BENCH)

study: setup ## train, score and judge every row of PLAN=studies/plans/10k.toml (goes on where it was stopped)
	$(BIN)/grasp-study run '$(PLAN)'

test: setup lint types ## everything that CI checks (at most 10 minutes)
	$(BIN)/python -P -m pytest -n $(TEST_WORKERS) --dist loadfile

faults: setup ## break every command in every way that is listed: results/faults.json and the table in RESULTS.md [FAULTS='--kind crash'] (goes on where it was stopped)
	$(BIN)/python -P tests/faults $(FAULTS)

soak: setup ## collect, train and evaluate in a loop for HOURS=3 with random kills: results/soak.json
	$(BIN)/python -P tests/faults --soak-hours $(HOURS)

python-versions: setup ## whether newer Pythons at hand collect the same bytes (3.12, 3.13; skips those that are not there)
	@bash .ci/python_versions.sh

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# Type checkers cannot follow the editable map of folders to subpackages: they are given an installed copy.
types: setup
	@rm -rf .types build
	@$(BIN)/python -m pip install -q --disable-pip-version-check --no-deps --no-build-isolation --target .types .
	@rm -rf build
	cd .types && ../$(BIN)/mypy --config-file ../pyproject.toml -p graspq && ../$(BIN)/mypy --config-file ../pyproject.toml ../examples

clean: ## remove what can be made again, but for data/ and runs/
	rm -rf $(VENV) $(VENV)-3.* .types build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
