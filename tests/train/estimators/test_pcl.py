"""Gaussian policies in closed form, path consistency as a sum and as an optimum, the tuned penalty, and dz = -1.

That `pcl` reaches the regularised optimum of a known decision process stands in `test_learning`.
"""

import math
from typing import Any

import pytest
import torch
from plain import ACTION, plain_networks
from torch import Tensor, nn

from graspq.train.batch import Batch
from graspq.train.estimators import ESTIMATORS
from graspq.train.estimators.pcl import (
    Gaussian,
    PclSettings,
    log_density,
    path_consistency,
    policy_of,
    relative_entropy,
    residual,
    target,
    tuned,
)
from graspq.train.networks.network import StateNetwork
from graspq.train.state import Networks, TrainState, seeded
from graspq.train.targets import corrected_episode_value, discounted_return, path_consistent


def numbers(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=seeded("tests/pcl", seed), dtype=torch.float64)


def gaussian(seed: int) -> Gaussian:
    return Gaussian(numbers(5, 4, seed=seed) * 2 - 1, numbers(5, 4, seed=seed + 1) - 1)


def test_densities_and_relative_entropies_are_torchs_own() -> None:
    policy, other, action = gaussian(1), gaussian(3), numbers(5, 4, seed=5)
    first, second = (torch.distributions.Normal(p.mean, p.log_deviation.exp()) for p in (policy, other))
    constant = 2 * math.log(2 * math.pi)
    torch.testing.assert_close(log_density(policy, action) - constant, first.log_prob(action).sum(-1))
    expected = torch.distributions.kl_divergence(first, second).sum(-1)
    torch.testing.assert_close(relative_entropy(policy, other), expected)
    torch.testing.assert_close(relative_entropy(policy, policy), torch.zeros(5, dtype=torch.float64))


def test_a_policy_starts_straight_down_and_no_output_takes_its_deviation_out_of_bounds() -> None:
    policy = policy_of(torch.zeros(1, 8), ACTION)
    torch.testing.assert_close(policy.mean, torch.tensor([[0.0, 0.0, -1.0, 0.0]]))
    torch.testing.assert_close(policy.log_deviation.exp(), torch.full((1, 4), 0.5))
    narrow, wide = policy_of(torch.full((1, 8), -1e6), ACTION), policy_of(torch.full((1, 8), 1e6), ACTION)
    torch.testing.assert_close(narrow.log_deviation.exp(), torch.full((1, 4), 0.1))
    torch.testing.assert_close(wide.log_deviation.exp(), torch.full((1, 4), 1.0))
    far = log_density(narrow, torch.ones(1, 4)) - log_density(wide, torch.ones(1, 4))
    assert math.isfinite(float(far)) and abs(float(far)) < 1100


MASK = torch.tensor([[True, True, True, True], [True, True, False, False]])


@pytest.mark.parametrize("path_steps", [1, 2, 3, 4, 9, None])
def test_the_target_is_the_explicit_sum_and_reads_nothing_after_the_end(path_steps: int | None) -> None:
    reward, value, ratio = numbers(2, 4, seed=1), numbers(2, 4, seed=2), numbers(2, 4, seed=3)
    discount, penalty = 0.7, 0.3
    expected = torch.zeros(2, 4, dtype=torch.float64)
    for b, length in enumerate(MASK.sum(1).tolist()):
        for t in range(length):
            d = length - t if path_steps is None else path_steps
            inside = range(t, min(t + d, length))
            expected[b, t] = sum(discount ** (i - t) * (reward[b, i] - penalty * ratio[b, i]) for i in inside)
            if t + d < length:
                expected[b, t] += discount**d * value[b, t + d]
    spoilt = [torch.where(MASK, tensor, torch.nan) for tensor in (reward, value, ratio)]
    target = path_consistent(*spoilt, penalty, discount, path_steps, MASK)
    torch.testing.assert_close(target, expected, rtol=0, atol=1e-12)


def test_at_the_first_step_it_is_the_corrected_episode_value_less_the_first_penalty() -> None:
    reward, advantage = numbers(3, 5, seed=1), -numbers(3, 5, seed=2)
    ours = path_consistent(reward, torch.zeros_like(reward), advantage / 0.4, 0.4, 0.9)
    torch.testing.assert_close(ours, corrected_episode_value(reward, advantage, 1.0, 0.9) - advantage)
    torch.testing.assert_close(
        path_consistent(reward, torch.zeros_like(reward), advantage, 0.0, 0.9), discounted_return(reward, 0.9)
    )


def test_with_paths_of_one_step_the_target_follows_the_next_value_by_the_discount_and_its_own_ratio_alone() -> None:
    reward, value, ratio = numbers(2, 4, seed=1), numbers(2, 4, seed=2), numbers(2, 4, seed=3)
    discount, penalty = 0.7, 0.3
    # [B, T] of the target by [B, T] of what it may follow.
    by_value, by_ratio = torch.autograd.functional.jacobian(
        lambda v, rho: path_consistent(reward, v, rho, penalty, discount, 1, MASK), (value, ratio)
    )
    next_value, own_ratio = torch.zeros(2, 2, 4, 2, 4, dtype=torch.float64)
    for b, length in enumerate(MASK.sum(1).tolist()):
        for t in range(length):
            own_ratio[b, t, b, t] = -penalty
            if t + 1 < length:
                next_value[b, t, b, t + 1] = discount
    torch.testing.assert_close(by_value, next_value, rtol=0, atol=1e-12)
    torch.testing.assert_close(by_ratio, own_ratio, rtol=0, atol=1e-12)


class Outputs(StateNetwork):
    """A function of the step alone: row `step` of a table."""

    def __init__(self, table: Tensor) -> None:
        super().__init__()
        self.table = nn.Parameter(table)

    def forward(self, image: Tensor, step: Tensor) -> Tensor:
        return self.table[step]


def networks_of(actor: Tensor, lagged: Tensor, value: Tensor) -> Networks:
    return plain_networks(
        {"actor": Outputs(actor), "v": Outputs(value)},
        {"actor": Outputs(lagged), "v": Outputs(value)},
        kept={"penalty": torch.tensor(0.25)},
    )


def arguments(batch: Batch, given: Networks, settings: PclSettings) -> tuple[Any, ...]:
    return batch, given, settings, seeded("tests/draws"), 0.0


def episodes(action: Tensor, reward: Tensor, mask: Tensor | None = None) -> Batch:
    size, steps = reward.shape
    terminal = torch.zeros(size, steps, dtype=torch.bool)
    return Batch(
        image=torch.zeros(size, steps, 1, 1, 3, dtype=torch.uint8),
        step=torch.arange(steps).expand(size, -1),
        action=action,
        reward=reward,
        terminal=terminal,
        mc_return=reward,
        synthetic_action=action,
        mask=mask,
    )


@pytest.mark.parametrize("penalty", [None, 2.0])
def test_the_loss_is_half_the_mean_squared_residual_of_real_steps_with_the_given_or_the_tuned_penalty(
    penalty: float | None,
) -> None:
    actor, lagged, value = numbers(4, 8, seed=1).float(), numbers(4, 8, seed=2).float(), numbers(4, 1, seed=3).float()
    action, reward = numbers(2, 4, 4, seed=4).float(), numbers(2, 4, seed=5).float()
    given = arguments(episodes(action, reward, MASK), networks_of(actor, lagged, value), PclSettings(penalty=penalty))
    ratio = log_density(policy_of(actor, ACTION), action) - log_density(policy_of(lagged, ACTION), action)
    v = value.squeeze(-1).expand(2, -1)
    wanted = path_consistent(reward, v, ratio, penalty or 0.25, 0.9, None, MASK)
    torch.testing.assert_close(target(*given), wanted)
    expected = 0.5 * (v - wanted)[MASK].square().mean()
    torch.testing.assert_close(residual(ESTIMATORS["pcl"], *given), expected)


def test_the_gradient_flows_through_the_value_at_both_ends_of_a_path_and_through_the_policy() -> None:
    actor, lagged, value = numbers(4, 8, seed=1).float(), numbers(4, 8, seed=2).float(), numbers(4, 1, seed=3).float()
    action, reward = numbers(2, 4, 4, seed=4).float(), numbers(2, 4, seed=5).float()
    batch, penalty, discount, real = episodes(action, reward, MASK), 2.0, 0.9, int(MASK.sum())
    networks = networks_of(actor, lagged, value)
    given = arguments(batch, networks, PclSettings(penalty=penalty, path_steps=1))
    residual(ESTIMATORS["pcl"], *given).backward()
    delta = (value.squeeze(-1) - target(*given).detach()) * MASK
    # ∂ mean ½ δ² / ∂ V(s_t) = mean δ_t - γ δ_{t-1} where there is a step t;  by π: mean λ δ_t ∂ log π(a_t|s_t)
    by_value = delta.clone()
    by_value[:, 1:] -= discount * delta[:, :-1] * MASK[:, 1:]
    torch.testing.assert_close(networks.online["v"].table.grad.squeeze(-1), by_value.sum(0) / real)
    outputs = actor.clone().requires_grad_()
    log_policy = log_density(policy_of(outputs, ACTION), action)
    (by_policy,) = torch.autograd.grad((penalty * delta * log_policy).sum() / real, outputs)
    torch.testing.assert_close(networks.online["actor"].table.grad, by_policy)
    assert float(by_policy.abs().min()) > 1e-4 and networks.lagged["actor"].table.grad is None


@pytest.mark.parametrize("penalty", [None, 2.0])
def test_a_step_divides_the_policys_gradient_by_the_penalty_and_leaves_that_of_the_value(penalty: float | None) -> None:
    actor, lagged, value = numbers(4, 8, seed=1).float(), numbers(4, 8, seed=2).float(), numbers(4, 1, seed=3).float()
    batch = episodes(numbers(2, 4, 4, seed=4).float(), numbers(2, 4, seed=5).float(), MASK)
    plain, stepped = (networks_of(actor.clone(), lagged, value.clone()) for _ in range(2))
    settings = PclSettings(penalty=penalty)
    residual(ESTIMATORS["pcl"], *arguments(batch, plain, settings)).backward()
    path_consistency(ESTIMATORS["pcl"], state_of(stepped), batch, settings, seeded("tests/draws"), 0.0)
    for part, divisor in (("actor", 0.25 if penalty is None else penalty), ("v", 1.0)):
        torch.testing.assert_close(stepped.online[part].table.grad, plain.online[part].table.grad / divisor)


@pytest.mark.parametrize("penalty", [None, 2.0])
def test_a_step_tunes_the_penalty_by_the_divergence_at_its_real_states_unless_it_is_given(
    penalty: float | None,
) -> None:
    actor, lagged, value = numbers(4, 8, seed=1).float(), numbers(4, 8, seed=2).float(), numbers(4, 1, seed=3).float()
    batch = episodes(numbers(2, 4, 4, seed=4).float(), numbers(2, 4, seed=5).float(), MASK)
    policies = [policy_of(output, ACTION) for output in (actor, lagged)]
    first, second = (torch.distributions.Normal(p.mean, p.log_deviation.exp()) for p in policies)
    by_step = torch.distributions.kl_divergence(first, second).sum(-1)
    divergence = float(by_step.expand(2, -1)[MASK].mean())
    assert divergence > 0.05 and abs(divergence - float(by_step.mean())) > 0.005
    # Between 0 and twice the bound, where the step is not clipped.
    networks, settings = networks_of(actor, lagged, value), PclSettings(penalty=penalty, kl_bound=divergence / 1.3)
    path_consistency(ESTIMATORS["pcl"], state_of(networks), batch, settings, seeded("tests/draws"), 0.0)
    expected = 0.25 * math.exp(0.02 * 0.3) if penalty is None else 0.25
    assert float(networks.kept["penalty"]) == pytest.approx(expected, rel=1e-6)


def test_on_a_quadratic_reward_it_vanishes_at_the_policy_times_exp_of_reward_over_the_penalty() -> None:
    """π ∝ π' exp(r / λ) and V = λ log E_π' exp(r / λ): π' (0, 0.5²), r = 0.6 - (dx - 0.3)², λ = 0.5."""
    penalty, top = 0.5, 0.3
    precision = 1 / 0.25 + 2 / penalty
    mean, deviation = (2 * top / penalty) / precision, precision**-0.5
    logged = torch.linspace(-1, 1, 9)
    reward = 0.6 - (logged - top).square()
    # ∫ N(a; 0, ½²) exp(r(a) / λ) da, by completing the square.
    exponent = -0.5 * top**2 * 2 / penalty + 0.5 * mean**2 * precision
    value = 0.6 + penalty * (math.log(deviation / 0.5) + exponent)
    lagged = Gaussian(torch.zeros(9, 1), torch.full((9, 1), math.log(0.5)))
    best = Gaussian(torch.full((9, 1), mean), torch.full((9, 1), math.log(deviation)))
    ratio = log_density(best, logged.unsqueeze(1)) - log_density(lagged, logged.unsqueeze(1))
    target = path_consistent(reward.unsqueeze(1), torch.zeros(9, 1), ratio.unsqueeze(1), penalty, 0.9)
    torch.testing.assert_close(target, torch.full((9, 1), value), rtol=0, atol=1e-6)


def test_the_penalty_rises_above_the_bound_and_falls_below_it_within_its_limits() -> None:
    def after(penalty: float, divergence: float) -> float:
        return float(tuned(torch.tensor(penalty), torch.tensor(divergence), 0.01))

    assert after(1.0, 0.01) == 1.0
    assert after(1.0, 0.015) == pytest.approx(math.exp(0.01)) and after(1.0, 9.0) == pytest.approx(math.exp(0.02))
    assert after(1.0, 0.0) == pytest.approx(math.exp(-0.02))
    assert after(100.0, 9.0) == 100.0 and after(0.01, 0.0) == pytest.approx(0.01)


class Normalised(StateNetwork):
    """Outputs that depend on the step, normalised over the batch; its running mean is that of the last batch."""

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.BatchNorm1d(1, momentum=1.0)
        self.last = nn.Linear(1, 8)

    def forward(self, image: Tensor, step: Tensor) -> Tensor:
        output: Tensor = self.last(self.norm(step.float().unsqueeze(1)))
        return output


@pytest.mark.parametrize(("states", "mean"), [(100, 49.5), (300, 148.0)])  # all; 0, 4, 8, .. 296
def test_evenly_spread_states_give_the_statistics_that_both_policies_use(states: int, mean: float) -> None:
    actors = [Normalised() for _ in range(2)]
    actors[1].load_state_dict(actors[0].state_dict())
    actors[1].eval()
    value = Outputs(torch.zeros(states, 1))
    kept = {"penalty": torch.tensor(0.25)}
    networks = plain_networks({"actor": actors[0], "v": value}, {"actor": actors[1], "v": value}, kept=kept)
    batch = episodes(torch.zeros(1, states, 4), torch.zeros(1, states))
    path_consistency(ESTIMATORS["pcl"], state_of(networks), batch, PclSettings(), seeded("tests/draws"), 0.0)
    for network in actors:
        assert float(network.norm.running_mean) == pytest.approx(mean)
    # Two policies of equal weights did not differ: neither used the batch's own statistics.
    assert float(networks.kept["penalty"]) == pytest.approx(0.25 * math.exp(-0.02), rel=1e-3)


def state_of(networks: Networks) -> TrainState:
    """Return a training's state with these networks."""
    optimizers = {
        part: torch.optim.AdamW(network.parameters(), lr=0.05, weight_decay=0.0)
        for part, network in networks.online.items()
    }
    return TrainState(step=0, networks=networks, averaged={}, optimizers=optimizers)


def trained(action: Tensor, reward: Tensor, value: float, periods: int) -> tuple[Gaussian, list[float]]:
    """Train one state's policy from a V for periods of 20 steps between lagged copies; return it and all losses."""
    networks = networks_of(torch.zeros(1, 8), torch.zeros(1, 8), torch.full((1, 1), value))
    state, settings = state_of(networks), PclSettings(penalty=0.3, actor_rate=1.0)
    losses = []
    for step in range(20 * periods):
        if step % 20 == 0:
            networks.lagged["actor"].load_state_dict(networks.online["actor"].state_dict())
        for part in state.optimizers:
            state.set_rate(part, 0.05)  # as the loop does before each update
        batch = episodes(action.unsqueeze(1), reward.unsqueeze(1))
        measured = path_consistency(ESTIMATORS["pcl"], state, batch, settings, seeded("tests/draws"), 0.0)
        losses.append(float(measured["loss"]))
    with torch.no_grad():
        return policy_of(networks.online["actor"](batch.image[:1, 0], batch.step[:1, 0]), ACTION), losses


def descending_data() -> Tensor:
    """2,000 actions as collected: uniform, and dz = -1 in nine of ten."""
    action = (numbers(2000, 4) * 2 - 1).float()
    action[torch.arange(2000) % 10 > 0, 2] = -1
    return action


def test_the_point_mass_at_dz_minus_one_does_not_narrow_the_policy_once_v_is_right_as_likelihood_would() -> None:
    action, same = descending_data(), torch.full((2000,), 0.25)
    right, losses = trained(action, same, 0.25, 15)
    torch.testing.assert_close(right.mean[0], torch.tensor([0.0, 0.0, -1.0, 0.0]), rtol=0, atol=1e-3)
    torch.testing.assert_close(right.log_deviation.exp()[0], torch.full((4,), 0.5), rtol=0, atol=1e-3)
    assert losses[-1] < 1e-9
    # Where V is too low every logged action looks good, and the policy follows the data until V has caught up.
    early, _ = trained(action, same, 0.0, 15)
    assert float(early.mean[0, 2]) > -0.92 and float(early.log_deviation.exp().max()) < 0.49


def test_where_the_point_mass_is_what_succeeds_the_deviation_of_dz_falls_no_further_than_its_bound() -> None:
    action = descending_data()
    policy, losses = trained(action, (action[:, 2] == -1).float(), 0.9, 40)
    deviation = policy.log_deviation.exp()[0]
    assert all(math.isfinite(loss) for loss in losses)
    assert -1.25 <= float(policy.mean[0, 2]) < -0.9
    assert 0.1 <= float(deviation[2]) < 0.2 < float(deviation[[0, 1, 3]].min())
