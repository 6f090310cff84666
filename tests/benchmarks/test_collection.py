"""Our side of the benchmark of collection: what is counted, and where the time of a grasp goes."""

import pytest

from graspq.benchmarks.collection import BLOCK, our_grasps, pace_of, phases
from graspq.benchmarks.measuring import Call, apart
from graspq.engine import EngineSettings
from graspq.objects.object_set import ObjectSet


def test_a_turn_counts_its_blocks_but_for_the_first(regular_objects: ObjectSet) -> None:
    tally = our_grasps(regular_objects.folder, 0, range(2))
    assert tally.grasps == BLOCK and tally.frames == tally.actions and BLOCK <= tally.actions <= 15 * BLOCK
    assert 0 < tally.core_seconds <= 1.1 * tally.seconds and 0 < tally.successes < BLOCK


def test_the_phases_of_a_grasp_make_a_whole_and_the_longest_stands_first(regular_objects: ObjectSet) -> None:
    (rows,) = apart([Call(phases, (regular_objects.folder, 0, 1))])
    times = [row["CPU ms"] for row in rows]
    assert times == sorted(times, reverse=True) and len(rows) == 7
    assert sum(float(row["share"].rstrip("%")) for row in rows) == pytest.approx(100, abs=4)
    rendering = next(row for row in rows if row["phase of a grasp"] == "rendering")
    assert rendering["PyBullet"] > rendering["Python"] > 0


def test_the_pace_of_workers_is_that_of_whole_blocks(regular_objects: ObjectSet) -> None:
    pace = pace_of(regular_objects.folder, 0, EngineSettings(workers=1), 1)
    assert 0 < pace.grasp < 5 and pace.grasp < pace.first_block
