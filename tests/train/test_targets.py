"""Targets against closed forms and against each other."""

import pytest
import torch

from graspq.train.targets import bootstrapped, discounted_return, episode_value

REWARD = torch.tensor([[0.0, 0.0, 1.0], [0.5, -1.0, 2.0]], dtype=torch.float64)
LAST = torch.tensor([[False, False, True], [False, False, True]])


def next_values(values: torch.Tensor) -> torch.Tensor:
    """Return V(s_{t+1}) of each step; there is none after the last."""
    return torch.cat([values[:, 1:], torch.full_like(values[:, :1], torch.nan)], dim=1)


@pytest.mark.parametrize("discount", [0.0, 0.3, 0.9, 1.0])
def test_the_recursion_of_the_return_equals_its_explicit_sum(discount: float) -> None:
    steps = REWARD.shape[1]
    explicit = torch.stack(
        [sum((discount ** (k - t)) * REWARD[:, k] for k in range(t, steps)) for t in range(steps)], dim=1
    )
    torch.testing.assert_close(discounted_return(REWARD, discount), explicit, rtol=0, atol=1e-15)


@pytest.mark.parametrize("discount", [0.0, 0.3, 0.9, 1.0])
def test_bootstrapped_equals_episode_value_when_v_is_the_observed_return_to_go(discount: float) -> None:
    returns = discounted_return(REWARD, discount)
    target = bootstrapped(REWARD, LAST, next_values(returns), discount)
    torch.testing.assert_close(target, episode_value(returns), rtol=0, atol=1e-15)


def test_all_targets_are_the_reward_at_discount_zero() -> None:
    values = torch.tensor([[3.0, 5.0, 7.0], [2.0, 4.0, 6.0]], dtype=torch.float64)
    assert torch.equal(bootstrapped(REWARD, LAST, values, 0.0), REWARD)
    assert torch.equal(episode_value(discounted_return(REWARD, 0.0)), REWARD)


def test_all_targets_are_the_reward_at_the_last_step() -> None:
    values = torch.full_like(REWARD, torch.nan)
    assert torch.equal(bootstrapped(REWARD, LAST, values, 0.9)[:, -1], REWARD[:, -1])
    assert torch.equal(episode_value(discounted_return(REWARD, 0.9))[:, -1], REWARD[:, -1])


def test_single_transitions_are_episodes_of_one_step() -> None:
    long = bootstrapped(REWARD, LAST, next_values(discounted_return(REWARD, 0.9)), 0.9)
    shape = (-1, 1)
    value = next_values(discounted_return(REWARD, 0.9)).reshape(shape)
    short = bootstrapped(REWARD.reshape(shape), LAST.reshape(shape), value, 0.9)
    assert torch.equal(short.view_as(long), long)


def test_rewards_on_padding_do_not_count() -> None:
    mask = torch.tensor([[True, True, False], [True, True, True]])
    returns = discounted_return(REWARD, 0.9, mask)
    assert torch.equal(returns[0], torch.zeros(3, dtype=torch.float64))
    assert torch.equal(returns[1], discounted_return(REWARD, 0.9)[1])


def test_shapes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="one shape"):
        bootstrapped(REWARD, LAST[:, :2], REWARD, 0.9)
