"""An estimator of one's own has the rights of ours: options, checks, resuming, acting."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from graspq.policies.of_run import load
from graspq.sim.observation import Observation
from graspq.train.cli import main
from graspq.train.run import Run

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
ALGO = "own_estimator:conservative"


@pytest.fixture
def grasp_train(monkeypatch, capsys):
    """Return what runs the command in this process, in the folder of the examples."""
    monkeypatch.chdir(EXAMPLES)

    def run(*words: str) -> SimpleNamespace:
        with pytest.raises(SystemExit) as ended:
            main(words, prog_name="grasp-train")
        output = capsys.readouterr()
        return SimpleNamespace(returncode=ended.value.code, stdout=output.out, stderr=output.err)

    return run


@pytest.fixture(scope="module")
def dataset(tmp_path_factory, collect_regular, regular_objects) -> Path:
    return collect_regular(tmp_path_factory.mktemp("own") / "data", regular_objects, 4, 5)


def test_its_coefficient_is_an_option_that_is_shown_and_checked(dataset: Path, grasp_train) -> None:
    shown = grasp_train("--algo", ALGO, "--help").stdout
    assert "Options of --algo own_estimator:conservative" in shown and "--alpha FLOAT" in shown
    refused = grasp_train("--algo", ALGO, "--shards", str(dataset), "--alpha", "-1")
    assert refused.returncode == 2 and "--alpha: expected a number of at least 0, got -1" in refused.stderr
    other = grasp_train("--algo", "mc", "--shards", str(dataset), "--alpha", "1")
    assert other.returncode == 2 and "it is no option of --algo mc with --network default" in other.stderr


def test_it_trains_goes_on_and_acts_with_its_own_network(dataset: Path, tmp_path: Path, grasp_train) -> None:
    options = ["--batch-size", "16", "--steps", "4", "--save-every", "2", "--threads", "1", "--precision", "float32"]
    words = ["--algo", ALGO, "--shards", str(dataset), *options]
    for alpha in ("0", "5"):
        done = grasp_train(*words, "--alpha", alpha, "--learning-rate", "0.02", "--out", str(tmp_path / alpha))
        assert done.returncode == 0, done.stderr
    run = Run.open(tmp_path / "5")
    assert run.config["settings"]["own"]["alpha"] == 5.0
    again = grasp_train(*words, "--alpha", "4", "--learning-rate", "0.02", "--out", str(tmp_path / "5"))
    assert again.returncode == 2 and "holds a run with alpha = 5.0, not 4.0" in again.stderr
    observation = Observation(np.zeros((64, 64, 3), np.uint8), 0, np.zeros(4, np.float32))
    worth = []
    for alpha in ("0", "5"):
        policy = load(tmp_path / alpha, device="cpu")
        assert type(policy.acting.networks["q"]).__name__ == "SmallNetwork"
        action = policy.act(observation, np.random.default_rng(0))
        assert action.shape == (4,) and np.abs(action).max() <= 1
        worth.append(policy.q)
    assert worth[0] != worth[1], "the penalty must matter"
