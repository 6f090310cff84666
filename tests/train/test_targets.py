"""Targets against closed forms and against each other."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from graspq.train.targets import (
    blended,
    bootstrapped,
    corrected_episode_value,
    discounted_return,
    double_q,
    episode_value,
    floored,
    lambda_return,
    n_step,
)

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


@st.composite
def paths(draw: st.DrawFn) -> dict[str, torch.Tensor]:
    """Draw Q of the logged actions and V ≥ Q along paths of 1 to 6 steps in padded batches, and rewards."""
    batch, steps = draw(st.integers(1, 3)), draw(st.integers(1, 6))
    lengths = draw(st.lists(st.integers(1, steps), min_size=batch, max_size=batch))
    mask = torch.arange(steps) < torch.tensor(lengths).unsqueeze(1)
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    q, worse, reward = (torch.randn(batch, steps, generator=generator, dtype=torch.float64) for _ in range(3))
    last = mask & ~torch.cat([mask[:, 1:], torch.zeros_like(mask[:, :1])], dim=1)
    return {"q": q, "value": q + worse.abs(), "reward": reward, "mask": mask, "last": last}


discounts = st.floats(0, 1)


@given(paths(), discounts, st.floats(0, 1))
def test_the_recursion_of_the_corrected_value_equals_its_explicit_sum(
    path: dict[str, torch.Tensor], discount: float, nu: float
) -> None:
    advantage, mask = path["q"] - path["value"], path["mask"]
    result = corrected_episode_value(path["reward"], advantage, nu, discount, mask)
    for row, length in enumerate(mask.sum(1).tolist()):
        for t in range(length):
            explicit = float(path["reward"][row, t])
            for k in range(t + 1, length):
                explicit += discount ** (k - t) * float(path["reward"][row, k] - nu * advantage[row, k])
            assert result[row, t].item() == pytest.approx(explicit, abs=1e-12)


@given(paths(), discounts)
def test_corrected_equals_episode_value_when_the_logged_actions_are_greedy_or_nu_is_zero(
    path: dict[str, torch.Tensor], discount: float
) -> None:
    returns = episode_value(discounted_return(path["reward"], discount, path["mask"]))
    greedy = corrected_episode_value(path["reward"], torch.zeros_like(path["q"]), 1.0, discount, path["mask"])
    uncorrected = corrected_episode_value(path["reward"], path["q"] - path["value"], 0.0, discount, path["mask"])
    torch.testing.assert_close(greedy, returns, rtol=0, atol=1e-14)
    torch.testing.assert_close(uncorrected, returns, rtol=0, atol=1e-14)


@given(paths(), discounts)
def test_corrected_equals_bootstrapped_when_q_is_bellman_consistent_along_the_path(
    path: dict[str, torch.Tensor], discount: float
) -> None:
    """Q_t = r_t + γ V_{t+1}, and Q_T = r_T: then both are Q itself."""
    value = path["value"]
    q = bootstrapped(path["reward"], path["last"], next_values(value), discount)
    corrected = corrected_episode_value(path["reward"], q - value, 1.0, discount, path["mask"])
    torch.testing.assert_close(corrected[path["mask"]], q[path["mask"]], rtol=0, atol=1e-12)


@given(paths(), discounts, st.integers(1, 7))
def test_the_n_step_target_is_its_explicit_sum_with_nothing_after_the_end(
    path: dict[str, torch.Tensor], discount: float, steps: int
) -> None:
    reward, mask = path["reward"], path["mask"]
    value = torch.cat([torch.full_like(reward[:, :1], torch.nan), path["value"][:, 1:]], dim=1)
    result = n_step(reward, value, discount, steps, mask)
    assert torch.equal(result[~mask], torch.zeros_like(result[~mask]))
    for row, length in enumerate(mask.sum(1).tolist()):
        for t in range(length):
            end = min(t + steps, length)
            explicit = sum(discount ** (k - t) * float(reward[row, k]) for k in range(t, end))
            explicit += discount**steps * float(value[row, end]) if t + steps < length else 0.0
            assert result[row, t].item() == pytest.approx(explicit, abs=1e-12)


@given(paths(), discounts)
def test_n_step_is_bootstrapped_at_one_and_the_episode_value_from_the_horizon_on(
    path: dict[str, torch.Tensor], discount: float
) -> None:
    reward, value, mask = path["reward"], path["value"], path["mask"]
    once = bootstrapped(reward, path["last"], next_values(value), discount)
    torch.testing.assert_close(n_step(reward, value, discount, 1, mask)[mask], once[mask], rtol=0, atol=1e-12)
    returns = episode_value(discounted_return(reward, discount, mask))
    for steps in (None, reward.shape[1], 9):
        assert torch.equal(n_step(reward, value, discount, steps, mask), returns)


@given(paths(), discounts, st.floats(0, 1))
def test_the_lambda_return_is_the_fading_mean_of_the_n_step_targets_and_reads_nothing_else(
    path: dict[str, torch.Tensor], discount: float, trace_decay: float
) -> None:
    reward, mask = path["reward"].where(path["mask"], torch.nan), path["mask"]
    value = torch.cat([torch.full_like(reward[:, :1], torch.nan), path["value"][:, 1:]], dim=1).where(mask, torch.nan)
    longest = reward.shape[1]
    mean = trace_decay ** (longest - 1) * discounted_return(reward, discount, mask)
    for n in range(1, longest):
        mean = mean + (1 - trace_decay) * trace_decay ** (n - 1) * n_step(reward, value, discount, n, mask)
    # The weights of n-step targets that reach beyond an episode's end all fall on its return.
    result = lambda_return(reward, value, trace_decay, discount, mask)
    torch.testing.assert_close(result, mean, rtol=0, atol=1e-12)
    once = bootstrapped(reward, path["last"], next_values(value), discount)
    torch.testing.assert_close(lambda_return(reward, value, 0.0, discount, mask)[mask], once[mask], rtol=0, atol=1e-12)


def test_a_floor_raises_targets_to_the_return_and_lowers_none() -> None:
    returns, target = torch.tensor([[0.5, 0.0, 1.0]]), torch.tensor([[0.3, 0.2, 1.0]])
    assert torch.equal(floored(returns, target), torch.tensor([[0.5, 0.2, 1.0]]))
    with pytest.raises(ValueError, match="one shape"):
        floored(returns, target[:, :2])


@given(paths(), discounts)
def test_blended_without_advantages_is_td_lambda_from_bootstrapped_at_zero_to_the_episode_value_at_one(
    path: dict[str, torch.Tensor], discount: float
) -> None:
    reward, value, mask, nothing = path["reward"], path["value"], path["mask"], torch.zeros_like(path["q"])
    ends = [bootstrapped(reward, path["last"], next_values(value), discount), discounted_return(reward, discount, mask)]
    for weight, expected in zip((0.0, 1.0), ends, strict=True):
        result = blended(reward, value, nothing, torch.full_like(reward, weight), discount, mask)
        torch.testing.assert_close(result[mask], expected[mask], rtol=0, atol=1e-12)
    # λ = 1/2: Σ_n (1 - λ) λ^{n-1} n-step, and what is left of the weights on the return.
    longest = reward.shape[1]
    mean = sum(0.5**n * n_step(reward, value, discount, n, mask) for n in range(1, longest))
    mean = mean + 0.5 ** (longest - 1) * discounted_return(reward, discount, mask)
    result = blended(reward, value, nothing, torch.full_like(reward, 0.5), discount, mask)
    torch.testing.assert_close(result, mean, rtol=0, atol=1e-12)


def test_in_double_q_one_network_picks_the_best_candidate_and_the_other_judges_it_and_what_is_beside() -> None:
    candidates = torch.tensor([[[1.0], [2.0], [3.0]], [[4.0], [5.0], [6.0]]])
    q = torch.tensor([[0.0, 2.0, 2.0], [7.0, 0.0, -1.0]])
    beside = torch.tensor([[[8.0]], [[9.0]]])
    asked: list[torch.Tensor] = []

    def judge(action: torch.Tensor) -> torch.Tensor:
        asked.append(action)
        return -10 * action.squeeze(-1)

    assert double_q(q, candidates, judge).tolist() == [[-20.0], [-40.0]], "the first of equals"
    assert double_q(q, candidates, judge, beside).tolist() == [[-80.0, -20.0], [-90.0, -40.0]]
    assert [list(action.shape) for action in asked] == [[2, 1, 1], [2, 2, 1]]


@given(paths())
def test_one_step_of_the_corrected_recursion_is_a_bootstrap_from_the_corrected_value(
    path: dict[str, torch.Tensor],
) -> None:
    """y_t = r_t + γ (y_{t+1} - ν A_{t+1}) is the Bellman target for V_{t+1} = y_{t+1} - ν A_{t+1}."""
    advantage = path["q"] - path["value"]
    corrected = corrected_episode_value(path["reward"], advantage, 0.7, 0.9, path["mask"])
    again = bootstrapped(path["reward"], path["last"], next_values(corrected - 0.7 * advantage), 0.9)
    torch.testing.assert_close(corrected[path["mask"]], again[path["mask"]], rtol=0, atol=1e-12)


def test_the_correction_raises_returns_after_bad_actions_beyond_one_and_is_not_clipped() -> None:
    reward = torch.tensor([[0.0, 0.0, 1.0]])
    advantage = torch.tensor([[torch.nan, -0.5, -0.25]])
    corrected = corrected_episode_value(reward, advantage, 1.0, 1.0)
    assert torch.equal(corrected, torch.tensor([[1.75, 1.25, 1.0]]))


def test_all_targets_are_the_reward_at_discount_zero() -> None:
    values = torch.tensor([[3.0, 5.0, 7.0], [2.0, 4.0, 6.0]], dtype=torch.float64)
    assert torch.equal(bootstrapped(REWARD, LAST, values, 0.0), REWARD)
    assert torch.equal(corrected_episode_value(REWARD, -values, 1.0, 0.0), REWARD)
    assert torch.equal(episode_value(discounted_return(REWARD, 0.0)), REWARD)
    assert torch.equal(n_step(REWARD, values, 0.0, 2), REWARD)
    assert torch.equal(lambda_return(REWARD, values, 0.5, 0.0), REWARD)
    assert torch.equal(blended(REWARD, values, -values, values / 7, 0.0), REWARD)


def test_all_targets_are_the_reward_at_the_last_step() -> None:
    values = torch.full_like(REWARD, torch.nan)
    assert torch.equal(bootstrapped(REWARD, LAST, values, 0.9)[:, -1], REWARD[:, -1])
    assert torch.equal(episode_value(discounted_return(REWARD, 0.9))[:, -1], REWARD[:, -1])
    assert torch.equal(corrected_episode_value(REWARD, -REWARD.abs(), 1.0, 0.9)[:, -1], REWARD[:, -1])


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
