"""Our side of the benchmark of collection: what is counted, and where the time of a grasp goes."""

import pytest

from graspq.benchmarks.collection import BLOCK, HERE, our_grasps, phases
from graspq.benchmarks.harness import alone
from graspq.engine import EngineSettings
from graspq.objects.object_set import ObjectSet


@pytest.mark.parametrize("engine", [HERE, EngineSettings(workers=2)])
def test_a_turn_counts_the_blocks_of_each_worker_but_for_the_first(
    regular_objects: ObjectSet, engine: EngineSettings
) -> None:
    tally = our_grasps(regular_objects.folder, 0, engine, 1)
    assert tally.grasps == max(engine.workers or 0, 1) * BLOCK
    assert tally.frames == tally.actions and tally.grasps <= tally.actions <= 15 * tally.grasps
    assert 0 < tally.seconds < 100 and tally.begun > 0


def test_the_phases_of_a_grasp_make_a_whole_and_the_longest_stands_first(regular_objects: ObjectSet) -> None:
    rows = alone(phases, regular_objects.folder, 0, 1)
    times = [row["CPU ms"] for row in rows]
    assert times == sorted(times, reverse=True) and len(rows) == 7
    assert sum(float(row["share"].rstrip("%")) for row in rows) == pytest.approx(100, abs=4)
    rendering = next(row for row in rows if row["phase of a grasp"] == "rendering")
    assert rendering["rasteriser"] > rendering["Python"] > 0
