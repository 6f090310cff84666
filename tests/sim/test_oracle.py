import dataclasses

import numpy as np
import pytest

from graspq.sim.episode import GraspSimulation
from graspq.sim.oracle import Oracle
from graspq.sim.task import TASKS, draw_objects


def successes(task, objects, episodes):
    oracle, won = Oracle(), 0
    with GraspSimulation(task, objects) as simulation:
        for episode in range(episodes):
            rng = np.random.default_rng(episode)
            simulation.load(draw_objects(task, objects, "train", rng))
            simulation.reset(rng)
            outcome = simulation.step(oracle.act(simulation))
            while not outcome.terminated:
                outcome = simulation.step(oracle.act(simulation))
            won += outcome.info["success"]
    return won


@pytest.mark.parametrize(("count", "least"), [(1, 24), (5, 22)])
def test_the_oracle_lifts_nearly_always(regular_objects, count, least):
    task = dataclasses.replace(TASKS["regular"], objects_per_bin=count)
    assert successes(task, regular_objects, 25) >= least


def test_the_oracle_lifts_targets_from_clutter(targeted_objects):
    assert successes(TASKS["targeted"], targeted_objects, 12) >= 9
