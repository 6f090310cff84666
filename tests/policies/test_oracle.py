import dataclasses

import numpy as np
import pytest

from graspq.policies.oracle import Oracle
from graspq.sim.episode import GraspSimulation
from graspq.sim.play import play
from graspq.sim.task import TASKS


def successes(task, objects, episodes):
    oracle, won = Oracle(), 0
    with GraspSimulation(task, objects) as simulation:
        for episode in range(episodes):
            rng = np.random.default_rng(episode)
            simulation.load(task.draw(objects, "train", rng))
            simulation.reset(rng)
            won += play(simulation, oracle, rng).success
    return won


@pytest.mark.parametrize(("count", "least"), [(1, 24), (5, 22)])
def test_the_oracle_lifts_nearly_always(regular_objects, count, least):
    task = TASKS["regular"]
    task = task.with_settings(dataclasses.replace(task.settings, objects_per_bin=count))
    assert successes(task, regular_objects, 25) >= least


def test_the_oracle_lifts_targets_from_clutter(targeted_objects):
    assert successes(TASKS["targeted"], targeted_objects, 12) >= 9
