"""A plan as small as plans get, and the twelve grasps that it learns from."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from graspq.objects.object_set import ObjectSet
from graspq.studies.study.cells import Cell, cells_of
from graspq.studies.study.plan_file import StudyPlan, read_plan

os.environ.setdefault("OMP_NUM_THREADS", "1")

TINY = """
rows = ["mc", {algo = "dql", width = [4, 5]}]
sizes = ["12"]
seeds = 2
preset = "paper"
steps = 3
episodes = 2
data = "DATA"
recipe = "recipe.json"
policies = ["random"]
options = {width = 4, batch_size = 8}
"""


@pytest.fixture(scope="session")
def data(
    collect_regular: Callable[..., Path], regular_objects: ObjectSet, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A folder of datasets: one, of twelve grasps of the random policy."""
    folder = tmp_path_factory.mktemp("data")
    collect_regular(folder / "regular-12", regular_objects, 4, 3)
    return folder


@pytest.fixture
def plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[StudyPlan, list[Cell]]]:
    """Return what writes the tiny plan, some of its words replaced, in a working folder of its own, and reads it."""
    monkeypatch.chdir(tmp_path)

    def write(*replaced: tuple[str, str], data: Path | str = "data") -> tuple[StudyPlan, list[Cell]]:
        text = TINY.replace("DATA", str(data))
        for one, other in replaced:
            assert one in text
            text = text.replace(one, other)
        Path("tiny.toml").write_text(text)
        read = read_plan(Path("tiny.toml"))
        return read, cells_of(read, tmp_path / "study", workers=0, device="cpu")

    return write
