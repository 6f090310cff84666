"""A small but real world: procedural objects, grasps from the simulator in a dataset, and a run trained on it."""

import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")

BLOCKS, BLOCK_SIZE = 4, 3


@pytest.fixture(scope="session")
def objects_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from graspq.objects.procedural import make_procedural

    folder = tmp_path_factory.mktemp("objects") / "regular"
    make_procedural(folder, seed=0, train=6, test=6, validation=6)
    return folder


@pytest.fixture(scope="session")
def dataset(
    collect_regular: Callable[..., Path], objects_folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Grasps of the random policy, with the object set beside them."""
    from graspq.objects.object_set import ObjectSet

    folder = tmp_path_factory.mktemp("data") / "regular"
    return collect_regular(folder, ObjectSet.load(objects_folder), BLOCKS, BLOCK_SIZE)


@pytest.fixture(scope="session")
def run_folder(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of `mc` with the paper's network, four steps long, with two validations and two checkpoints."""
    from graspq.train.loop import train
    from graspq.train.settings import complete

    folder = tmp_path_factory.mktemp("runs") / "mc"
    settings = complete(
        {
            "algo": "mc",
            "shards": (str(dataset),),
            "out": folder,
            "steps": 4,
            "batch_size": 8,
            "save_every": 2,
            "validation_fraction": 0.25,
            "device": "cpu",
            "precision": "float32",
            "threads": 1,
        },
        "paper",
    )
    train(settings)
    return folder


@pytest.fixture
def command(capfd: pytest.CaptureFixture[str]) -> "Command":
    return Command(capfd)


class Command:
    """Runs a console script's function in this process; gives exit status and what it printed."""

    def __init__(self, capfd: pytest.CaptureFixture[str]) -> None:
        self._capfd = capfd

    def __call__(self, name: str, *arguments: str | Path) -> SimpleNamespace:
        from graspq.evaluate.cli import main as grasp_eval

        main = {"grasp-eval": grasp_eval}[name]
        self._capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in arguments], prog_name=name)
        out, err = self._capfd.readouterr()
        return SimpleNamespace(code=ended.value.code, out=out, err=err, lines=err.strip().splitlines())
