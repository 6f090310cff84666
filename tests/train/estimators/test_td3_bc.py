"""`td3-bc`: its target's noise and smaller critic, and where its actor ends between cloning and climbing."""

import itertools
from collections.abc import Callable

import pytest
import torch
from plain import ACTION, plain_networks
from torch import Tensor, nn

from graspq.train.batch import Batch
from graspq.train.checkpoint import load_acting
from graspq.train.estimators.td3_bc import Td3BcSettings, cloning_actor_critic, row, slope_and_q, target
from graspq.train.loop import train
from graspq.train.networks.network import Features, QNetwork, StateNetwork
from graspq.train.selection import pointed
from graspq.train.settings import TrainSettings
from graspq.train.state import TrainState, seeded


class Says(StateNetwork):
    """An actor that points the same way in every state."""

    def __init__(self, *direction: float) -> None:
        super().__init__()
        start, wanted = torch.tensor([0.0, 0.0, -1.0, 0.0]) / 1.25, torch.tensor(direction) / 1.25
        self.output = nn.Parameter(wanted * (1 - wanted**2).rsqrt() - start * (1 - start**2).rsqrt())

    def forward(self, image: Tensor, step: Tensor) -> Tensor:
        return self.output.expand(len(image), -1)


class Line(QNetwork):
    """Q(s, a) = factor · dx + offset."""

    link = "identity"

    def __init__(self, factor: float, offset: float) -> None:
        super().__init__()
        self.factor, self.offset = nn.Parameter(torch.tensor(factor)), nn.Parameter(torch.tensor(offset))

    def trunk(self, image: Tensor, step: Tensor) -> Features:
        return (torch.zeros(len(step)),)

    def head(self, features: Features, action: Tensor) -> Tensor:
        return self.factor * action[..., 0] + self.offset + features[0].unsqueeze(1)


def batch(rows: int = 2) -> Batch:
    image = torch.zeros(rows, 1, 8, 8, 3, dtype=torch.uint8)
    step, action = torch.zeros(rows, 1, dtype=torch.int64), torch.zeros(rows, 1, 4)
    terminal = torch.zeros(rows, 1, dtype=torch.bool)
    terminal[0] = True
    return Batch(image, step, action, terminal.float(), terminal, torch.zeros(rows, 1), action, image, step + 1)


def target_of(at: float, settings: Td3BcSettings, twin: tuple[float, float], rows: int = 2) -> Tensor:
    online = {"q": Line(-9.0, -9.0), "twin": Line(-9.0, -9.0), "actor": Says(-0.9, 0.0, 0.0, 0.0)}
    lagged = {"q": Line(1.0, 0.0), "twin": Line(*twin), "actor": Says(at, 0.0, 0.0, 0.0)}
    return target(batch(rows), plain_networks(online, lagged), settings, seeded("tests/draws"), 0.0).squeeze(1)


def test_the_smaller_of_the_lagged_critics_judges_the_lagged_actors_action() -> None:
    still = Td3BcSettings(smoothing=0.0)
    for twin, expected in (((1.0, 5.0), 0.5), ((1.0, -0.1), 0.4), ((-1.0, 0.2), -0.3)):
        torch.testing.assert_close(target_of(0.5, still, twin), torch.tensor([1.0, 0.9 * expected]))
    torch.testing.assert_close(target_of(1.2, still, (1.0, 0.0)), torch.tensor([1.0, 0.9]), msg="clipped")


def test_the_judged_action_has_clipped_noise_and_stays_in_the_box() -> None:
    settings = Td3BcSettings(smoothing=0.4, smoothing_bound=0.5)
    found = target_of(0.0, settings, (1.0, 0.0), rows=4001)[1:] / 0.9
    assert float(found.mean()) == pytest.approx(0, abs=0.02)
    # Of a normal distribution clipped at 1.25 deviations: Var = σ² [1 - 2 c φ(c) - 2 (1 - c²)(1 - Φ(c))], c = 1.25.
    assert float(found.std()) == pytest.approx(0.4 * 0.8079, abs=0.01)
    assert float(found.abs().max()) == pytest.approx(0.5)
    inside = target_of(1.2, settings, (1.0, 0.0), rows=4001)[1:] / 0.9
    assert float(inside.max()) == pytest.approx(1.0) and float((inside < 0.999).float().mean()) == pytest.approx(
        0.5, abs=0.03
    )


def test_the_slope_is_that_of_q_inside_the_box_and_zero_beyond_it() -> None:
    slope = torch.tensor([0.25, -7.0, -0.5, 0.5])
    found, q = slope_and_q(lambda action: (action * slope).sum(-1), torch.tensor([[0.5, 0.9, 1.2, -1.1]]))
    assert found.tolist() == [[0.25, -7.0, 0.0, 0.0]]
    assert float(q) == pytest.approx(0.125 - 6.3 - 0.5 - 0.5)


@pytest.mark.parametrize(("alpha", "offset"), [(0.0, 2.0), (1.0, 2.0), (1.0, 4.0)])
def test_the_actor_ends_where_cloning_balances_the_climb_by_q_over_its_mean(alpha: float, offset: float) -> None:
    online: dict[str, nn.Module] = {"q": Line(1.0, offset), "twin": Line(0.0, 0.0), "actor": Says(0.3, 0.3, 0.3, 0.3)}
    rates = {"q": 0.0, "twin": 0.01, "actor": 0.01}
    optimizers = {
        name: torch.optim.AdamW(one.parameters(), lr=rates[name], weight_decay=0.0) for name, one in online.items()
    }
    state = TrainState(0, plain_networks(online, online), {}, optimizers)
    settings = Td3BcSettings(alpha=alpha, actor_every=1, loss="squared")
    for _ in range(500):
        cloning_actor_critic(row, state, batch(), settings, seeded("tests/draws"), 0.0)
    actor, twin = online["actor"], online["twin"]
    assert isinstance(actor, Says) and isinstance(twin, Line)
    dx = float(pointed(actor.output, ACTION)[0])
    # The mean over four parts of (dx - 0)² has slope dx / 2; λ ∂Q/∂dx is α / (offset + dx).
    assert dx / 2 == pytest.approx(alpha / (offset + dx), abs=2e-3)
    assert float(twin.offset) != 0.0, "the second critic learns too"


def test_the_actor_waits_for_its_turn_and_both_critics_move_at_every_step(
    settings: Callable[..., TrainSettings],
) -> None:
    chosen = settings("td3-bc", preset="paper", steps=5, save_every=1, actor_every=2)
    states = [load_acting(train(chosen, stop_at=step).folder, step).networks for step in (1, 2, 3, 4)]
    assert set(states[0]) == {"q", "actor", "twin"}
    changed = {
        part: [
            any(
                not torch.equal(value, after[part].state_dict()[name])
                for name, value in before[part].state_dict().items()
            )
            for before, after in itertools.pairwise(states)
        ]
        for part in states[0]
    }
    assert changed == {"actor": [False, True, False], "q": [True] * 3, "twin": [True] * 3}
