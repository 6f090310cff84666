"""A run that is real and small: grasps from the simulator, and a network trained on them for four steps."""

import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from graspq.objects.object_set import ObjectSet

os.environ.setdefault("OMP_NUM_THREADS", "1")


@pytest.fixture(scope="session")
def run_folder(
    collect_regular: Callable[..., Path], regular_objects: ObjectSet, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A run of `mc` with the paper's network, with two validations and two checkpoints."""
    from graspq.train.loop import train
    from graspq.train.settings import complete

    dataset = collect_regular(tmp_path_factory.mktemp("data") / "regular", regular_objects, 4, 3)
    folder = tmp_path_factory.mktemp("runs") / "mc"
    given = {
        "algo": "mc", "shards": (str(dataset),), "out": folder, "steps": 4, "batch_size": 8, "save_every": 2,
        "validation_fraction": 0.25, "device": "cpu", "threads": 1,
    }  # fmt: skip
    train(complete(given, "paper"))
    return folder


@pytest.fixture
def grasp_report(capfd: pytest.CaptureFixture[str]) -> Callable[..., SimpleNamespace]:
    """Run the command in this process; return its exit status and the lines that it printed on standard error."""
    from graspq.report.cli import main

    def run(*arguments: str | Path) -> SimpleNamespace:
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in arguments], prog_name="grasp-report")
        return SimpleNamespace(code=ended.value.code, lines=capfd.readouterr().err.strip().splitlines())

    return run
