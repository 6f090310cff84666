"""`corr-mc` on Q-functions whose values are known: its advantages, its annealing, and the bias of what it does."""

from typing import Any

import pytest
import torch
from plain import plain_networks
from torch import Tensor, nn

from graspq.common.errors import UserError
from graspq.train.advantages import LaterValues, advantages, later_values
from graspq.train.batch import Batch
from graspq.train.estimator import cross_entropy
from graspq.train.estimators.corr_mc import CorrMcSettings, annealed, row, target
from graspq.train.networks.network import Features, QNetwork
from graspq.train.selection import uniform_actions
from graspq.train.state import Networks, TrainState, seeded
from graspq.train.targets import corrected_episode_value

MASK = torch.tensor([[True, True, True], [True, False, False], [True, True, False]])


class Peak(QNetwork):
    """Q(s, a) = step - |dx|, or normal noise of a fixed deviation instead: always the same for the same action."""

    link = "identity"

    def __init__(self, deviation: float = 0.0, seed: int = 0) -> None:
        super().__init__()
        self.deviation, self.seed, self.states = deviation, seed, []

    def trunk(self, image: Tensor, step: Tensor) -> Features:
        self.states.append(step)
        return (step.float(),)

    def head(self, features: Features, action: Tensor) -> Tensor:
        if self.deviation == 0:
            return features[0].unsqueeze(1) - action[..., 0].abs()
        waves = torch.tensor([127.1, 311.7, 74.7, 269.5], dtype=torch.float64) + 10.3 * self.seed
        uniform = ((action.double() * waves).sum(-1).sin() * 43758.5453).frac().abs()
        return (features[0].unsqueeze(1) + self.deviation * torch.special.ndtri(uniform.clamp(1e-9, 1 - 1e-9))).float()


def networks(lagged: QNetwork, network: QNetwork | None = None) -> Networks:
    return plain_networks({"q": Peak() if network is None else network}, {"q": lagged})


def settings(**given: Any) -> CorrMcSettings:
    return CorrMcSettings(**{"discount": 0.9} | given)


def seen_by(batch: Batch, given: Networks, chosen: CorrMcSettings) -> LaterValues:
    return later_values(batch, given, chosen, seeded("tests/draws"))


def sampled_advantage(batch: Batch, given: Networks, chosen: CorrMcSettings) -> Tensor:
    return advantages(batch, seen_by(batch, given, chosen), 1.0, chosen)


def corrected(batch: Batch, given: Networks, chosen: CorrMcSettings, progress: float = 1.0) -> Tensor:
    return target(batch, given, chosen, seeded("tests/draws"), progress)


def episodes(mask: Tensor = MASK) -> Batch:
    batch, steps = mask.shape
    action = torch.rand(batch, steps, 4, generator=seeded("tests/actions")) * 2 - 1
    return Batch(
        image=torch.zeros(batch, steps, 2, 2, 3, dtype=torch.uint8),
        step=torch.arange(steps).expand(batch, -1),
        action=action,
        reward=mask * torch.arange(1.0, 1 + steps),
        terminal=mask & ~torch.cat([mask[:, 1:], torch.zeros_like(mask[:, :1])], dim=1),
        mc_return=torch.zeros(batch, steps),
        synthetic_action=action,
        mask=mask,
    )


def later_draws(candidates: int = 16) -> Tensor:
    """Return the candidates' dx at the three later steps of `episodes()`, [3, N]."""
    generator = seeded("tests/draws")
    by_step = torch.stack([uniform_actions(generator, 3, candidates, 4)[..., 0] for _ in range(3)], dim=1)
    return torch.stack([by_step[0, 1], by_step[0, 2], by_step[2, 1]])


def at_later(values: Tensor) -> Tensor:
    return torch.stack([values[0, 1], values[0, 2], values[2, 1]])


class Tilted(Peak):
    """Q(s, a) = factor · dx."""

    def __init__(self, factor: float) -> None:
        super().__init__()
        self.factor = factor

    def head(self, features: Features, action: Tensor) -> Tensor:
        return self.factor * action[..., 0]


@pytest.mark.parametrize("judge", ["online", "lagged"])
def test_v_is_the_online_networks_pick_of_the_uniform_actions_as_the_lagged_one_judges_it(judge: str) -> None:
    batch = episodes()
    seen = seen_by(batch, networks(Tilted(-10.0), Tilted(3.0)), settings(judge=judge))
    logged, drawn = at_later(batch.action[..., 0]), later_draws()
    torch.testing.assert_close(at_later(seen.value), -10 * drawn.amax(1))
    torch.testing.assert_close(at_later(seen.q), (3 if judge == "online" else -10) * logged)
    assert int(seen.value.isnan().sum()) == int(seen.q.isnan().sum()) == 6, "nothing else is computed"


@pytest.mark.parametrize("judge", ["online", "lagged"])
def test_advantages_are_not_clamped_and_a_good_logged_action_has_one_above_zero(judge: str) -> None:
    batch = episodes()
    batch.action[0, 1, 0] = 0.0
    found = at_later(sampled_advantage(batch, networks(Peak()), settings(judge=judge, candidates=1)))
    expected = later_draws(1)[:, 0].abs() - at_later(batch.action[..., 0]).abs()
    torch.testing.assert_close(found, expected)
    assert float(found[0]) > 0.1 and float(found.min()) < -0.1


def test_clamped_advantages_are_against_the_best_of_the_candidates_and_the_logged_action() -> None:
    batch = episodes()
    for judge in ("online", "lagged"):
        advantage = sampled_advantage(batch, networks(Peak()), settings(clamped=True, judge=judge))
        logged, drawn = at_later(batch.action[..., 0]).abs(), later_draws().abs().amin(1)
        torch.testing.assert_close(at_later(advantage), torch.minimum(logged, drawn) - logged, rtol=0, atol=1e-6)
    # The lagged network thinks the reverse of the online one, which then picks the worst: the logged one is above it.
    seen = seen_by(batch, networks(Tilted(-1.0), Tilted(1.0)), settings(clamped=True, judge="lagged", candidates=1))
    assert torch.equal(at_later(seen.value), at_later(seen.q))


def test_both_trunks_run_once_for_each_state_that_is_read() -> None:
    lagged, network = Peak(), Peak()
    corrected(episodes(), networks(lagged, network), settings())
    assert [step.tolist() for step in lagged.states] == [step.tolist() for step in network.states] == [[1, 2, 1]]


def test_the_target_is_the_papers_sum_and_the_observed_return_at_the_start_of_training() -> None:
    batch = episodes()
    a = sampled_advantage(batch, networks(Peak()), settings())
    found = corrected(batch, networks(Peak()), settings())
    first = 1 + 0.9 * (2 - a[0, 1]) + 0.81 * (3 - a[0, 2])
    torch.testing.assert_close(found[0], torch.stack([first, 2 + 0.9 * (3 - a[0, 2]), torch.tensor(3.0)]))
    observed = torch.tensor([[1 + 0.9 * 2 + 0.81 * 3, 2 + 0.9 * 3, 3], [1, 0, 0], [1 + 0.9 * 2, 2, 0]])
    for centred in (False, True):
        start = corrected(batch, networks(Peak()), settings(centred=centred), progress=0.0)
        torch.testing.assert_close(start, observed)


def test_episodes_of_one_step_need_no_network() -> None:
    lagged = Peak()
    batch = episodes(torch.ones(2, 1, dtype=torch.bool))
    assert torch.equal(corrected(batch, networks(lagged), settings()), batch.reward)
    assert lagged.states == []


def test_nu_rises_from_zero_to_one_over_the_given_part_and_stays() -> None:
    assert [annealed(progress, 0.5) for progress in (0.0, 0.25, 0.5, 0.9)] == [0.0, 0.5, 1.0, 1.0]
    assert annealed(0.0, 0.0) == 1.0


class Side(QNetwork):
    """Q(s, a) = dy where the picture's left column is bright, -dy where the right one is."""

    link = "identity"

    def trunk(self, image: Tensor, step: Tensor) -> Features:
        return (image[:, 0, 0, 0].float() - image[:, 0, -1, 0].float(),)

    def head(self, features: Features, action: Tensor) -> Tensor:
        return features[0].unsqueeze(1) * action[..., 1]


def test_in_the_mirror_a_symmetric_q_picks_the_same_and_a_network_that_knows_no_mirror_image_does_not() -> None:
    class Blind(Side):
        def trunk(self, image: Tensor, step: Tensor) -> Features:
            return (torch.ones(len(image)),)

    batch = episodes()
    batch.image[:, :, :, 0] = 1
    plain = seen_by(batch, networks(Side(), Side()), settings())
    mirrored = seen_by(batch, networks(Side(), Side()), settings(look_in_mirror=True))
    torch.testing.assert_close(mirrored.value, plain.value, equal_nan=True)
    other = seen_by(batch, networks(Side(), Blind()), settings(look_in_mirror=True))
    # It picks the candidate that is the worst here, and judges the logged action the other way round.
    assert bool((plain.value > other.value)[MASK][[1, 2, 5]].all())
    torch.testing.assert_close(at_later(other.q), -at_later(batch.action[..., 1]))
    torch.testing.assert_close(at_later(mirrored.q), at_later(plain.q))


@pytest.mark.parametrize(
    ("picker", "clamped", "expected"),
    [(1, False, 0.0), (1, True, 0.5642 * 16 / 17), (0, False, 1.7660), (0, True, 1.7940)],
    ids=["another's pick", "another's, clamped", "its own maximum", "its own, clamped"],
)
def test_v_of_noisy_values_is_right_by_double_q_and_too_high_where_it_is_clamped_or_judged_by_the_picker(
    picker: int, clamped: bool, expected: float
) -> None:
    """All actions are equally good, so every true advantage is 0: what is measured is bias, in deviations of noise.

    One network's own maximum over n values is too high by the expected maximum of n standard normal numbers; clamped,
    another's pick is too high by that of two, the pick and the logged action, where these are two.
    """
    batch = episodes(torch.ones(4000, 6, dtype=torch.bool))
    given = networks(Peak(deviation=0.1), Peak(deviation=0.1, seed=picker))
    chosen = settings(clamped=clamped, judge="lagged")
    bias = -float(sampled_advantage(batch, given, chosen)[:, 1:].mean()) / 0.1
    assert bias == pytest.approx(expected, abs=0.025)


def judged_at_random(mask: Tensor) -> LaterValues:
    generator = seeded("tests/judged")
    q, value = torch.rand(2, *mask.shape, generator=generator)
    unread = ~mask | (torch.arange(mask.shape[1]) == 0)
    q = torch.where(unread, torch.nan, q)
    return LaterValues(torch.where(unread, torch.nan, torch.maximum(q, value)), q)


class Table(Peak):
    """Q(s, a) = a weight of the step, the same for all actions."""

    def __init__(self, *values: float) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.tensor(values))

    def trunk(self, image: Tensor, step: Tensor) -> Features:
        return (self.weight[step],)

    def head(self, features: Features, action: Tensor) -> Tensor:
        return features[0].unsqueeze(1).expand(action.shape[:2])


def stepped(chosen: CorrMcSettings, progress: float = 1.0) -> Tensor:
    """Return by how much one step of gradient descent at rate 1 changes the weights of a table, [T]."""
    network, lagged = Table(0.5, 0.25, -0.5), Table(0.3, 0.6, 0.9)
    state = TrainState(0, networks(lagged, network), {}, {"q": torch.optim.SGD(network.parameters(), lr=1.0)})  # type: ignore[dict-item]
    before, batch = network.weight.detach().clone(), episodes()
    metrics = row.update(row, state, batch, chosen, seeded("tests/draws"), progress)
    assert set(metrics) == {"loss", "q", "target"} and not any(value.requires_grad for value in metrics.values())
    return network.weight.detach() - before


def test_the_papers_step_goes_down_the_gradient_of_the_target_and_the_default_step_does_not() -> None:
    table, v = torch.tensor([0.5, 0.25, -0.5], dtype=torch.float64, requires_grad=True), (0.3, 0.6, 0.9)
    losses, fixed, uncorrected = [], [], []
    for length in (3, 1, 2):
        for t in range(length):
            after = range(t + 1, length)
            returns = sum(0.9 ** (k - t) * (k + 1) for k in range(t, length))
            later = sum((0.9 ** (k - t) * (table[k] - v[k]) for k in after), torch.tensor(0.0))
            losses.append(0.5 * (table[t] - (returns - later)) ** 2)
            fixed.append(0.5 * (table[t] - (returns - later.detach())) ** 2)
            uncorrected.append(0.5 * (table[t] - returns) ** 2)
    # The lagged table has one value for all actions: by itself no action is worse than another.
    for judge, expected in (("online-gradient", losses), ("online", fixed), ("lagged", uncorrected)):
        (gradient,) = torch.autograd.grad(torch.stack(expected).mean(), table, retain_graph=True)
        chosen = settings(judge=judge, loss="squared", anneal=0.0)
        torch.testing.assert_close(stepped(chosen), -gradient.float(), rtol=0, atol=1e-5)
    # At the start of training there is no correction, and nothing to go through.
    assert torch.equal(
        stepped(settings(judge="online-gradient", loss="squared"), 0.0), stepped(settings(loss="squared"), 0.0)
    )


def test_the_gradient_of_targets_is_refused_with_a_loss_whose_slope_there_never_vanishes() -> None:
    with pytest.raises(
        UserError, match="--judge online-gradient: expected --loss squared or huber, got --loss cross-entropy"
    ):
        CorrMcSettings(judge="online-gradient")


def test_centred_targets_are_on_average_those_of_bootstrapping_and_keep_the_differences_between_episodes() -> None:
    mask = torch.arange(5) < torch.tensor([[5], [4], [4], [2], [1]])
    batch, seen = episodes(mask), judged_at_random(mask)
    shifted = advantages(batch, seen, 1.0, settings(centred=True))
    wanted = corrected_episode_value(batch.reward, shifted, 1.0, 0.9, mask)
    plain = corrected_episode_value(batch.reward, seen.q - seen.value, 1.0, 0.9, mask)
    for t in range(4):
        going_on = mask[:, t + 1]
        bootstrapped = (batch.reward[:, t] + 0.9 * seen.value[:, t + 1])[going_on]
        assert float(wanted[:, t][going_on].mean()) == pytest.approx(float(bootstrapped.mean()), abs=1e-5)
    same_length = [1, 2]
    difference = (plain[same_length[0]] - plain[same_length[1]])[:4]
    torch.testing.assert_close((wanted[same_length[0]] - wanted[same_length[1]])[:4], difference)
    shift = (shifted - (seen.q - seen.value))[mask & (torch.arange(5) > 0)]
    assert bool(shift.isfinite().all()) and float(shift.abs().max()) > 0.1


def test_centring_changes_nothing_where_the_lagged_network_is_right_on_average() -> None:
    mask = torch.arange(4) < torch.tensor([[4], [4], [3]])
    batch, seen = episodes(mask), judged_at_random(mask)
    q = seen.q
    for t in (3, 2, 1):  # Later targets first: those before depend on them.
        wanted = corrected_episode_value(batch.reward, q - seen.value, 0.7, 0.9, mask)
        q = q.clone()
        q[:, t] += (wanted - q)[:, t][mask[:, t]].mean()
    right = LaterValues(seen.value, q)
    plain = q - seen.value
    torch.testing.assert_close(
        advantages(batch, right, 0.7, settings(centred=True)), plain, equal_nan=True, rtol=0, atol=1e-6
    )


def test_cross_entropy_takes_targets_outside_zero_and_one_and_clipping_them_would_bring_bias() -> None:
    targets = torch.tensor([1.5, 0.25, -0.25, 0.7], dtype=torch.float64)  # their mean is 0.55, clipped 0.4875
    outputs = torch.linspace(-3, 3, 60_001, dtype=torch.float64)

    def best_q(values: Tensor) -> float:
        losses = cross_entropy(outputs.unsqueeze(1).expand(-1, 4), values.expand(len(outputs), -1)).mean(1)
        return float(outputs[losses.argmin()].sigmoid())

    assert best_q(targets) == pytest.approx(0.55, abs=5e-5)
    assert best_q(targets.clamp(0, 1)) == pytest.approx(0.4875, abs=5e-5)
    output = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    for value in (1.5, -0.25):
        (slope,) = torch.autograd.grad(cross_entropy(output, torch.tensor(value, dtype=torch.float64)), output)
        # Linear in the target, whatever the target is.
        assert float(slope) == pytest.approx(float(output.detach().sigmoid()) - value, abs=1e-12)
