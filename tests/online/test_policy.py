from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from graspq.common.errors import UserError
from graspq.common.seeding import generator
from graspq.evaluate.policies import Decision, Policy
from graspq.evaluate.settings import CemSettings
from graspq.online.policy import ExploringPolicy, LatestPolicy
from graspq.policies.random import RandomPolicy
from graspq.sim.observation import Observation


def seen(step: int = 0) -> Observation:
    return Observation(np.zeros((64, 64, 3), np.uint8), step, np.zeros(4, np.float32))


class StepTeller(Policy):
    """Its dx tells the step that it was shown."""

    def decide(
        self,
        images: np.ndarray,
        steps: np.ndarray,
        generators: Sequence[np.random.Generator | None],
        poses: np.ndarray | None = None,
    ) -> Decision:
        assert images.shape == (1, 64, 64, 3) and len(generators) == 1
        return Decision(np.array([[steps[0] / 20, 0, 0, 0]], np.float32), None)


def exploring(exploration: float) -> ExploringPolicy:
    return ExploringPolicy("dql@3", exploration, RandomPolicy(0.5), StepTeller())


def test_without_exploration_the_policy_acts_at_every_step() -> None:
    draws = generator("tests/online", 0)
    actions = [exploring(0.0).act(seen(step), draws) for step in range(15)]
    np.testing.assert_array_equal(np.stack(actions)[:, 0], np.arange(15, dtype=np.float32) / np.float32(20))


def test_with_full_exploration_the_actions_are_those_of_the_random_policy() -> None:
    ours, theirs = generator("tests/online", 1), generator("tests/online", 1)
    for step in range(15):
        theirs.random()  # the coin
        np.testing.assert_array_equal(exploring(1.0).act(seen(step), ours), RandomPolicy(0.5).act(None, theirs))


def test_the_coin_is_tossed_anew_at_each_step_and_the_policy_sees_the_true_step() -> None:
    draws = generator("tests/online", 2)
    actions = np.stack([exploring(0.3).act(seen(step % 15), draws) for step in range(6000)])
    greedy = (actions[:, 1] == 0) & (actions[:, 3] == 0)
    assert 1 - greedy.mean() == pytest.approx(0.3, abs=0.02)
    np.testing.assert_array_equal(
        actions[greedy, 0], (np.arange(6000) % 15)[greedy].astype(np.float32) / np.float32(20)
    )


def test_the_policy_of_a_checkpoint_carries_estimator_and_step_as_its_name(start: Path) -> None:
    made = LatestPolicy(start, 3, 0.25, RandomPolicy(), CemSettings())()
    assert (made.name, made.exploration) == ("dql@3", 0.25)
    action = made.act(seen(0), generator("tests/online", 3))
    assert action.shape == (4,) and action.dtype == np.float32 and np.abs(action).max() <= 1


def test_a_checkpoint_that_is_gone_is_named(start: Path) -> None:
    with pytest.raises(UserError, match="no checkpoint of step 4"):
        LatestPolicy(start, 4, 0.25, RandomPolicy(), CemSettings())()
