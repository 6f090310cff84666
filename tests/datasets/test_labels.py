import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspq.datasets.labels import mc_return, synthetic_action


def test_with_discount_one_every_step_has_the_return_of_the_episode():
    assert mc_return(np.array([0, 0, 1], np.float32), 1.0).tolist() == [1, 1, 1]


def test_a_final_reward_is_discounted_once_per_step_before_it():
    returns = mc_return(np.array([0, 0, 0, 1], np.float32), 0.9)
    np.testing.assert_allclose(returns, [0.729, 0.81, 0.9, 1.0], rtol=1e-7)
    assert returns.dtype == np.float32


@given(st.lists(st.floats(-2, 2, width=32), min_size=1, max_size=15), st.floats(0, 1))
def test_the_recursion_equals_the_explicit_sum(rewards, discount):
    explicit = [sum(discount ** (k - t) * rewards[k] for k in range(t, len(rewards))) for t in range(len(rewards))]
    np.testing.assert_allclose(mc_return(np.array(rewards, np.float32), discount), explicit, rtol=1e-6, atol=1e-6)


def test_discount_zero_gives_the_rewards():
    rewards = np.array([0.5, -1, 2], np.float32)
    assert mc_return(rewards, 0.0).tolist() == rewards.tolist()


@pytest.mark.parametrize("discount", [-0.1, 1.01, float("nan")])
def test_a_discount_outside_zero_to_one_is_refused(discount):
    with pytest.raises(ValueError, match="discount"):
        mc_return(np.ones(2, np.float32), discount)


def test_the_synthetic_action_executed_at_once_reaches_the_final_pose():
    poses = np.array([[0.1, 0.2, 0.3, 0.5], [0.2, 0.1, 0.2, 3.5]], np.float32)
    final, limits = np.array([0.4, 0.0, 0.1, -1.0], np.float32), (0.06, 0.06, 0.05, 0.7)
    actions = synthetic_action(poses, final, limits)
    np.testing.assert_allclose(poses + actions * np.array(limits), np.tile(final, (2, 1)), atol=1e-6)
    assert actions.dtype == np.float32


def test_the_angle_is_not_wrapped():
    start, final = np.array([[0, 0, 0, -3.0]], np.float32), np.array([0, 0, 0, 3.0], np.float32)
    assert synthetic_action(start, final, (1, 1, 1, 1))[0, 3] == 6.0


@pytest.mark.parametrize("limits", [(1, 1, 1, 0), (1, 1, 1), (1, -1, 1, 1)])
def test_limits_must_be_four_positive_numbers(limits):
    with pytest.raises(ValueError, match="action_limits"):
        synthetic_action(np.zeros((1, 4), np.float32), np.zeros(4, np.float32), limits)
