"""`blend`: the two ends of its target, and its weights in closed form and as they are measured."""

from collections.abc import Iterator
from typing import Any

import pytest
import tiny_mdp
import torch
from tiny_training import fit, tiny_networks, tiny_settings
from torch import Tensor

from graspq.train.estimators import ESTIMATORS
from graspq.train.estimators.blend import BINS, DECAY, cell_of, summed, weights
from graspq.train.settings import TrainSettings
from graspq.train.state import TrainState, seeded
from graspq.train.targets import blended, bootstrapped, corrected_episode_value

DISCOUNT = 0.9


def path() -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return reward, value, advantage, mask and terminal of two episodes of 4 and 2 steps, NaN where none is read."""
    generator = seeded("tests/blend")
    reward, value = torch.rand(2, 4, generator=generator), torch.rand(2, 4, generator=generator)
    advantage = -torch.rand(2, 4, generator=generator)
    mask = torch.tensor([[True] * 4, [True, True, False, False]])
    terminal = torch.tensor([[False, False, False, True], [False, True, False, False]])
    for tensor in (value, advantage):
        tensor[:, 0] = torch.nan
        tensor[~mask] = torch.nan
    return reward, value, advantage, mask, terminal


def test_weight_0_is_the_bootstrapped_target_and_weight_1_the_corrected_episode_value() -> None:
    reward, value, advantage, mask, terminal = path()
    following = torch.cat([value[:, 1:], torch.full((2, 1), torch.nan)], 1)
    nothing, whole = torch.zeros_like(reward), torch.ones_like(reward)
    low = blended(reward, value, advantage, nothing, DISCOUNT, mask)
    high = blended(reward, value, advantage, whole, DISCOUNT, mask)
    torch.testing.assert_close(low[mask], bootstrapped(reward, terminal, following, DISCOUNT)[mask])
    torch.testing.assert_close(high, corrected_episode_value(reward, advantage, 1.0, DISCOUNT, mask))
    assert not bool(low[~mask].any())


def test_the_recursion_is_the_sum_over_the_path_of_errors_faded_by_the_weights() -> None:
    reward, value, advantage, _, _ = path()
    reward, value, advantage = reward[:1], value[:1], advantage[:1]
    weight = torch.tensor([[torch.nan, 0.3, 0.8, 0.5]])
    q = value + advantage
    expected = reward[0, 0] + DISCOUNT * value[0, 1]
    fading = 1.0
    for t in range(1, 4):
        fading *= DISCOUNT * float(weight[0, t])
        after = DISCOUNT * value[0, t + 1] if t < 3 else 0.0
        expected = expected + fading * (reward[0, t] + after - q[0, t])
    torch.testing.assert_close(blended(reward, value, advantage, weight, DISCOUNT)[0, 0], expected)


def test_all_weights_give_the_reward_at_the_last_step_and_at_discount_0() -> None:
    reward, value, advantage, mask, terminal = path()
    for part in (0.0, 0.4, 1.0):
        weight = torch.full_like(reward, part)
        assert torch.equal(blended(reward, value, advantage, weight, DISCOUNT, mask)[terminal], reward[terminal])
        assert torch.equal(blended(reward, value, advantage, weight, 0.0, mask)[mask], reward[mask])


def measured(errors: Tensor, rows: int, cell: int = 3) -> float:
    """Return the weight of a cell after one batch in which it alone had these errors."""
    extra = {"blend_errors": torch.zeros(3, BINS, dtype=torch.float64), "blend_rows": torch.tensor(float(rows))}
    extra["blend_errors"] += summed(torch.full((len(errors),), cell), errors, BINS)
    return float(weights(extra)[cell])


def test_the_weight_is_the_share_of_bias_in_the_squared_error() -> None:
    errors = torch.tensor([0.5, 0.1, 0.3, 0.3])
    # Mean 0.3, sum of squared deviations 0.08; one observation of the common variance 0.02 is added to the four.
    variance = (0.08 + 0.08 / 4) / 4
    noise = variance / 1000
    bias = 0.3**2 - variance / (4 * (1 + DECAY)) - noise
    assert measured(errors, rows=1000) == pytest.approx(bias / (bias + noise), abs=1e-6)


def test_few_data_trust_the_bootstrap_where_many_find_the_same_error_real() -> None:
    generator = seeded("tests/blend/errors")
    errors = 0.05 + 0.4 * torch.randn(4000, generator=generator)
    found = [measured(errors, rows) for rows in (20, 500, 5_000, 50_000)]
    assert found == sorted(found)
    assert found[0] == 0.0 and 0.3 < found[1] < 0.95 and found[3] > 0.98
    assert measured(errors - errors.mean(), 50_000) == 0.0
    assert measured(errors + 0.5, 50) > 0.9


def test_a_cell_is_a_step_and_a_tenth_of_q() -> None:
    step, q = torch.tensor([0, 2, 2, 1, 1]), torch.tensor([0.05, 0.999, 1.0, -0.3, 1.7])
    assert cell_of(step, q).tolist() == [0, 29, 29, 10, 19]


@pytest.fixture(scope="module")
def networks() -> Iterator[None]:
    with tiny_networks():
        yield


def settings(**given: Any) -> TrainSettings:
    short: dict[str, Any] = {
        "batch_size": 128,
        "learning_rate": 3e-3,
        "weight_decay": 0.0,
    }
    return tiny_settings(**short | {"average_decay": 0.95} | given)


def learned(algo: str, data: tiny_mdp.Data, **given: Any) -> TrainState:
    return fit(ESTIMATORS[algo], data, settings(algo=algo, **given))


def mean_weight(state: TrainState) -> float:
    """Return λ, averaged over the steps that were seen of late."""
    count = state.networks.kept["blend_errors"][0]
    return float((weights(state.networks.kept) * count).sum() / count.sum())


@pytest.mark.usefixtures("networks")
def test_the_weight_is_high_while_q_is_wrong_and_falls_as_it_becomes_right() -> None:
    data = tiny_mdp.collect(20_000, 0)
    wrong = mean_weight(learned("blend", data, steps=30, schedule="constant", lag_steps=1000))
    right = mean_weight(learned("blend", data, steps=400, schedule="constant", lag_steps=10))
    # Measured: 0.86 and 0.28.
    assert wrong > 0.7 > 0.45 > right


@pytest.mark.usefixtures("networks")
def test_errors_of_earlier_batches_fade() -> None:
    data = tiny_mdp.collect(50, 0)
    state, row, own = learned("blend", data, steps=1), ESTIMATORS["blend"], settings(algo="blend").own
    batch = data.whole_episodes(torch.arange(50))
    counts = [float(state.networks.kept["blend_errors"][0].sum())]
    for _ in range(2):
        row.update(row, state, batch, own, seeded("tests/blend/fading"), 0.5)
        counts.append(float(state.networks.kept["blend_errors"][0].sum()))
    later = int(batch.later_steps.sum())
    assert counts[1] == pytest.approx(DECAY * counts[0] + later)
    assert counts[2] == pytest.approx(DECAY * counts[1] + later)


@pytest.mark.usefixtures("networks")
def test_validation_leaves_what_was_measured_as_it_is() -> None:
    data = tiny_mdp.collect(50, 0)
    state = learned("blend", data, steps=3)
    before = {name: tensor.clone() for name, tensor in state.networks.kept.items()}
    rows = torch.arange(50)
    row, own, random = ESTIMATORS["blend"], settings(algo="blend").own, seeded("tests/blend/validation")
    with torch.no_grad():
        loss = row.objective(row, data.whole_episodes(rows), state.networks, own, random, 0.5)
    assert float(loss) > 0
    assert all(torch.equal(before[name], tensor) for name, tensor in state.networks.kept.items())
    assert before["blend_errors"][0].sum() > 0
