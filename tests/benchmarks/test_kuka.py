"""The rival of collection: the wheel's environment runs from its own code, with the settings that are compared."""

import sys

from graspq.benchmarks.harness import alone
from graspq.benchmarks.kuka import MAX_STEPS, kuka_grasps


def test_the_wheels_environment_runs_and_obeys_the_protocol() -> None:
    tally = alone(kuka_grasps, 0, 1)
    assert tally.grasps == 1 and tally.seconds > 0
    # From 0.5 m down to 0.1 m by at most 0.06 m an action, and never more than T.
    assert 5 <= tally.actions <= MAX_STEPS
    assert tally.frames == tally.actions + 1
    # The stand-ins stay in the rival's process.
    assert "gym" not in sys.modules
    assert "pybullet_envs" not in sys.modules
