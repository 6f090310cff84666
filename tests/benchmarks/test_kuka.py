"""The rival of collection: the wheel's environment runs from its own code, with the settings that are compared."""

import sys
from pathlib import Path

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def test_the_wheels_environment_runs_and_obeys_the_protocol(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import kuka
    from players import Player

    with Player(kuka.collecting, 0, 1) as player:
        player.play()
    (tally,) = player.results
    assert tally.grasps == 1
    # From 0.5 m down to 0.1 m by at most 0.06 m an action, and never more than T.
    assert 5 <= tally.actions <= kuka.MAX_STEPS
    assert tally.frames == tally.actions + 1
    # The stand-ins stay in the rival's process.
    assert "gym" not in sys.modules
    assert "pybullet_envs" not in sys.modules
