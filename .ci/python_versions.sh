#!/usr/bin/env bash
# Compares the bytes of a short collection made on every newer Python that is at hand with those of .venv's.
# Each gets a .venv-X.Y of its own, with what the simulator needs and no more: no PyTorch.
set -euo pipefail
cd "$(dirname "$0")/.."
root=$PWD
first=.venv/bin/python
out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT

at_hand() { # a command that starts Python $1, or nothing
  for candidate in "python$1" "$HOME/.pyenv/versions/$1".*/bin/python"$1" "$(uv python find --no-python-downloads "$1" 2>/dev/null || true)"; do
    if [ -n "$candidate" ] && "$candidate" -c "import sys, ensurepip; sys.exit('%d.%d' % sys.version_info[:2] != '$1')" >/dev/null 2>&1; then
      echo "$candidate"
      return
    fi
  done
}

digests() { # collect with the Python $1 and print a hash of all steps and episodes
  (cd "$out" && rm -rf data && "$root/${1%python}grasp-datagen" --size 40 --workers 1 --seed 7 --out data >log 2>&1 || (cat log >&2 && exit 1)
    cd data && sha256sum shards/*.parquet episodes/*.parquet)
}

needed=$("$first" -c "
import tomllib
project = tomllib.load(open('pyproject.toml', 'rb'))['project']
print('\n'.join(p for p in project['dependencies'] + project['optional-dependencies']['sim'] if not p.startswith(('torch', 'tensorboard'))))")

tried=0
digests "$first" >"$out/expected"
for version in 3.12 3.13; do
  python=$(at_hand "$version")
  if [ -z "$python" ]; then
    echo "Python $version: not at hand, skipped"
    continue
  fi
  venv=.venv-$version
  [ -x "$venv/bin/python" ] || "$python" -m venv "$venv"
  xargs -d '\n' "$venv/bin/python" -m pip install -q --disable-pip-version-check -c constraints.txt setuptools wheel <<<"$needed"
  "$venv/bin/python" -m pip install -q --disable-pip-version-check --no-deps --no-build-isolation --force-reinstall .
  rm -rf build
  digests "$venv/bin/python" >"$out/found"
  if ! diff "$out/expected" "$out/found"; then
    echo "Python $version: other bytes than $("$first" --version)" >&2
    exit 1
  fi
  echo "Python $version: the same bytes as $("$first" --version): $(wc -l <"$out/found") files of 40 grasps"
  tried=$((tried + 1))
done
echo "Python versions compared with .venv's: $tried"
