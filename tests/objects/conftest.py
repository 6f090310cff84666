"""A small procedural set and a way to run the command, shared by the tests of objects/."""

from collections.abc import Callable
from pathlib import Path

import pytest

from graspq.objects.cli import main
from graspq.objects.object_set import ObjectSet
from graspq.objects.procedural import make_procedural

SEED = 7
TRAIN, TEST, VALIDATION = 48, 8, 8


@pytest.fixture(scope="session")
def small_set(tmp_path_factory: pytest.TempPathFactory) -> ObjectSet:
    """48 train, 8 test and 8 validation objects; not to be changed."""
    folder = tmp_path_factory.mktemp("objects") / "small"
    return make_procedural(folder, seed=SEED, train=TRAIN, test=TEST, validation=VALIDATION)


@pytest.fixture
def grasp_objects(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Return a function that runs `grasp-objects` and gives exit status, standard output and standard error."""

    def run(*arguments: str | Path) -> tuple[int, str, str]:
        capsys.readouterr()
        with pytest.raises(SystemExit) as stopped:
            main.main([str(argument) for argument in arguments], prog_name="grasp-objects")
        out, err = capsys.readouterr()
        return int(stopped.value.code or 0), out, err

    return run
