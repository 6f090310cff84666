"""`corr-mc` on Q-functions whose values are known: its advantages, its annealing, and the bias of what it does."""

import pytest
import torch
from plain_context import plain_context
from torch import Tensor

from graspq.train.batch import Batch
from graspq.train.corrected import annealed, corrected_target, sampled_advantage
from graspq.train.networks import Features, QNetwork
from graspq.train.selection import uniform_actions
from graspq.train.state import Context, seeded
from graspq.train.updates import cross_entropy

MASK = torch.tensor([[True, True, True], [True, False, False], [True, True, False]])


class Peak(QNetwork):
    """Q(s, a) = step - |dx|, with noise of a fixed deviation on every value."""

    link = "identity"

    def __init__(self, deviation: float = 0.0) -> None:
        super().__init__()
        self.deviation, self.noise, self.states = deviation, seeded("tests/noise"), []

    def trunk(self, image: Tensor, step: Tensor) -> Features:
        self.states.append(step)
        return (step.float(),)

    def head(self, features: Features, action: Tensor) -> Tensor:
        q = features[0].unsqueeze(1) - (action[..., 0].abs() if self.deviation == 0 else 0 * action[..., 0])
        return q + self.deviation * torch.randn(q.shape, generator=self.noise)


def context(lagged: QNetwork, *, progress: float = 1.0, candidates: int = 16) -> Context:
    return plain_context(
        {"q": Peak()}, {"q": lagged}, loss="cross-entropy", candidates=candidates, progress=progress, anneal=0.5
    )


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


def test_advantages_are_against_the_best_of_the_candidates_and_the_logged_action() -> None:
    lagged, batch = Peak(), episodes()
    advantage = sampled_advantage(batch, context(lagged))
    generator = seeded("tests/draws")
    by_step = torch.stack([uniform_actions(generator, batch=3)[..., 0].abs().amin(1) for _ in range(3)], dim=1)
    drawn = torch.stack([by_step[0, 1], by_step[0, 2], by_step[2, 1]])
    logged = torch.stack([batch.action[0, 1, 0], batch.action[0, 2, 0], batch.action[2, 1, 0]]).abs()
    expected = torch.minimum(logged, drawn) - logged
    read = torch.stack([advantage[0, 1], advantage[0, 2], advantage[2, 1]])
    torch.testing.assert_close(read, expected, rtol=0, atol=1e-6)
    assert bool((read <= 0).all()) and float(read.min()) < -0.1
    assert int(advantage.isnan().sum()) == 6, "nothing else is computed"


def test_the_trunk_of_the_lagged_network_alone_runs_once_for_each_state_that_is_read() -> None:
    lagged, given = Peak(), context(Peak())
    given.lagged_networks["q"] = lagged
    corrected_target(episodes(), given)
    assert [step.tolist() for step in lagged.states] == [[1, 2, 1]]
    assert given.network.states == []  # type: ignore[operator]


def test_the_target_is_the_papers_sum_and_the_observed_return_at_the_start_of_training() -> None:
    batch = episodes()
    a = sampled_advantage(batch, context(Peak()))
    corrected = corrected_target(batch, context(Peak()))
    first = 1 + 0.9 * (2 - a[0, 1]) + 0.81 * (3 - a[0, 2])
    torch.testing.assert_close(corrected[0], torch.stack([first, 2 + 0.9 * (3 - a[0, 2]), torch.tensor(3.0)]))
    observed = torch.tensor([[1 + 0.9 * 2 + 0.81 * 3, 2 + 0.9 * 3, 3], [1, 0, 0], [1 + 0.9 * 2, 2, 0]])
    torch.testing.assert_close(corrected_target(batch, context(Peak(), progress=0.0)), observed)


def test_episodes_of_one_step_need_no_network() -> None:
    lagged = Peak()
    batch = episodes(torch.ones(2, 1, dtype=torch.bool))
    assert torch.equal(corrected_target(batch, context(lagged)), batch.reward)
    assert lagged.states == []


def test_nu_rises_from_zero_to_one_over_the_given_part_and_stays() -> None:
    assert [annealed(progress, 0.5) for progress in (0.0, 0.25, 0.5, 0.9)] == [0.0, 0.5, 1.0, 1.0]
    assert annealed(0.0, 0.0) == 1.0


@pytest.mark.parametrize(("values", "expected_maximum"), [(2, 0.5642), (17, 1.7939)])
def test_the_maximum_over_noisy_values_is_too_high_by_what_order_statistics_say(
    values: int, expected_maximum: float
) -> None:
    """All actions are equally good, so every true advantage is 0: what is measured is bias, in deviations of noise."""
    batch = episodes(torch.ones(4000, 6, dtype=torch.bool))
    advantage = sampled_advantage(batch, context(Peak(deviation=0.1), candidates=values - 1))
    bias = -float(advantage[:, 1:].mean()) / 0.1
    assert bias == pytest.approx(expected_maximum, abs=0.03)


def test_cross_entropy_takes_targets_outside_zero_and_one_and_clipping_them_would_bring_bias() -> None:
    targets = torch.tensor([1.5, 0.25, -0.25, 0.7], dtype=torch.float64)  # their mean is 0.55, clipped 0.4875
    outputs = torch.linspace(-3, 3, 60_001, dtype=torch.float64)

    def best_q(values: Tensor) -> float:
        losses = cross_entropy(outputs.unsqueeze(1).expand(-1, 4), values.expand(len(outputs), -1)).mean(1)
        return float(outputs[losses.argmin()].sigmoid())

    assert best_q(targets) == pytest.approx(0.55, abs=5e-5)
    assert best_q(targets.clamp(0, 1)) == pytest.approx(0.4875, abs=5e-5)
    output = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    for target in (1.5, -0.25):
        (slope,) = torch.autograd.grad(cross_entropy(output, torch.tensor(target, dtype=torch.float64)), output)
        # Linear in the target, whatever the target is.
        assert float(slope) == pytest.approx(float(output.detach().sigmoid()) - target, abs=1e-12)
