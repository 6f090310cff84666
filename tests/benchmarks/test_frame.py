"""TinyRenderer is asked for the same pictures, and what is taken from it is not seen."""

from pathlib import Path

import numpy as np
from PIL import Image

from graspq.benchmarks.frame import TASK, at_its_best, moments, ours, rivals, write_sheet
from graspq.objects.object_set import ObjectSet
from graspq.sim.episode import GraspSimulation


def test_both_draw_the_same_scene_and_the_rival_at_its_best_draws_what_it_drew_before(
    regular_objects: ObjectSet,
) -> None:
    differences: list[float] = []
    with GraspSimulation(TASK, regular_objects) as simulation:
        simulation.load(TASK.draw(regular_objects, "train", np.random.default_rng(0)))
        simulation.reset(np.random.default_rng(0))
        before = rivals(simulation, 64)
        at_its_best(simulation)
        assert (rivals(simulation, 64) == before).mean() > 0.995
        for _ in moments(simulation, 1):
            one, two = ours(simulation, 64).astype(float), rivals(simulation, 64).astype(float)
            differences.append(float(np.abs(one - two).mean()))
            assert np.abs(one - two).mean() < 0.5 * np.abs(one - two[::-1]).mean()
    assert len(differences) > 3 and max(differences) < 15


def test_the_sheet_shows_both_at_both_sizes(regular_objects: ObjectSet, tmp_path: Path) -> None:
    with GraspSimulation(TASK, regular_objects) as simulation:
        write_sheet(simulation, tmp_path / "frames.png", scenes=1)
    with Image.open(tmp_path / "frames.png") as sheet:
        assert sheet.size == (4 * 256, 256)
        shown = np.asarray(sheet.convert("RGB"))
    assert (shown[::4, 0:256:4] == shown[3::4, 3:256:4]).all(), "four by four pixels of one"
