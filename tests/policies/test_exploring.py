import numpy as np
import pytest

from graspq.common.seeding import generator
from graspq.policies.exploring import ExploringPolicy
from graspq.policies.random import RandomPolicy
from graspq.sim.observation import Observation


class StepTeller:
    """Its dx tells the step that it was shown."""

    name, exploration = "dql@3", 0.0

    def act(self, observation, rng):
        return np.array([observation.step / 20, 0, 0, 0], np.float32)


def seen(step):
    return Observation(np.zeros((64, 64, 3), np.uint8), step, np.zeros(4, np.float32))


def exploring(exploration):
    return ExploringPolicy(exploration, RandomPolicy(0.5), StepTeller())


def test_without_exploration_the_policy_acts_at_every_step():
    draws = generator("tests/online", 0)
    actions = [exploring(0.0).act(seen(step), draws) for step in range(15)]
    np.testing.assert_array_equal(np.stack(actions)[:, 0], np.arange(15, dtype=np.float32) / np.float32(20))
    assert (exploring(0.25).name, exploring(0.25).exploration) == ("dql@3", 0.25)


def test_with_full_exploration_the_actions_are_those_of_the_random_policy():
    ours, theirs = generator("tests/online", 1), generator("tests/online", 1)
    for step in range(15):
        theirs.random()  # the coin
        np.testing.assert_array_equal(exploring(1.0).act(seen(step), ours), RandomPolicy(0.5).act(None, theirs))


def test_the_coin_is_tossed_anew_at_each_step_and_the_policy_sees_the_true_step():
    draws = generator("tests/online", 2)
    actions = np.stack([exploring(0.3).act(seen(step % 15), draws) for step in range(6000)])
    greedy = (actions[:, 1] == 0) & (actions[:, 3] == 0)
    assert 1 - greedy.mean() == pytest.approx(0.3, abs=0.02)
    np.testing.assert_array_equal(
        actions[greedy, 0], (np.arange(6000) % 15)[greedy].astype(np.float32) / np.float32(20)
    )
