"""`iql`: its expectile in closed form, what V, Q and the actor each learn from, and how a run with an actor acts."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from plain import ACTION, plain_networks
from torch import Tensor, nn

from graspq.train.acting import Acting, ObservedState
from graspq.train.batch import Batch
from graspq.train.checkpoint import load_acting
from graspq.train.estimators.iql import IqlSettings, expectile_loss, implicit_q_learning, row, target
from graspq.train.loop import train
from graspq.train.networks.network import Features, QNetwork, StateNetwork
from graspq.train.search_settings import CemSettings
from graspq.train.selection import pointed
from graspq.train.settings import TrainSettings
from graspq.train.state import TrainState, seeded


class Product(QNetwork):
    """Q(s, a) = factor · dx + step."""

    link = "identity"

    def __init__(self, factor: float) -> None:
        super().__init__()
        self.factor = nn.Parameter(torch.tensor(factor))

    def trunk(self, image: Tensor, step: Tensor) -> Features:
        return (step.float(),)

    def head(self, features: Features, action: Tensor) -> Tensor:
        return self.factor * action[..., 0] + features[0].unsqueeze(1)


class Says(StateNetwork):
    """The same outputs in every state."""

    def __init__(self, *outputs: float) -> None:
        super().__init__()
        self.outputs = nn.Parameter(torch.tensor(outputs))

    def forward(self, image: Tensor, step: Tensor) -> Tensor:
        return self.outputs.expand(len(image), -1)


def batch(dx: Tensor) -> Batch:
    """Return transitions at step 2 with these actions; the first half ends its episode with reward 1."""
    rows = len(dx)
    image = torch.zeros(rows, 1, 8, 8, 3, dtype=torch.uint8)
    action = torch.zeros(rows, 1, 4)
    action[:, 0, 0] = dx
    terminal = (torch.arange(rows) < rows // 2).unsqueeze(1)
    step = torch.full((rows, 1), 2)
    return Batch(image, step, action, terminal.float(), terminal, torch.zeros(rows, 1), action, image, step + 1)


def test_the_target_is_the_reward_and_the_discounted_v_of_the_trained_network() -> None:
    networks = plain_networks({"q": Product(9.0), "v": Says(0.5)}, {"q": Product(9.0), "v": Says(7.0)})
    found = target(batch(torch.zeros(4)), networks, IqlSettings(), seeded("tests/draws"), 0.0)
    torch.testing.assert_close(found.squeeze(1), torch.tensor([1.0, 1.0, 0.45, 0.45]))


@pytest.mark.parametrize(("expectile", "expected"), [(0.5, 0.5), (0.9, 0.75), (0.2, 1 / 3)])
def test_the_loss_is_least_at_the_expectile(expectile: float, expected: float) -> None:
    # Of U(0, 1): τ (1 - m)² = (1 - τ) m².
    values = torch.linspace(0, 1, 2001, dtype=torch.float64)
    grid = torch.linspace(0, 1, 1201, dtype=torch.float64)
    losses = torch.stack([expectile_loss(values - m, expectile).mean() for m in grid])
    assert float(grid[losses.argmin()]) == pytest.approx(expected, abs=1e-3)
    assert float(expectile_loss(torch.tensor(0.5), 0.9)) == pytest.approx(0.9 * 0.25)


def learning(value: float, settings: IqlSettings, steps: int, dx: Tensor) -> TrainState:
    """Return the state after some steps in which Q keeps its weights, that all of the lagged ones differ from."""
    online: dict[str, nn.Module] = {"q": Product(-5.0), "v": Says(value), "actor": Says(0.0, 0.0, 0.0, 0.0)}
    lagged: dict[str, nn.Module] = {"q": Product(1.0).requires_grad_(False)}
    state = TrainState(
        0,
        plain_networks(online, lagged),
        {},
        {name: torch.optim.AdamW(one.parameters(), lr=0.02, weight_decay=0.0) for name, one in online.items()},
    )
    state.set_rate("q", 0.0)
    for _ in range(steps):
        implicit_q_learning(row, state, batch(dx), settings, seeded("tests/draws"), 0.0)
    return state


def test_v_becomes_the_expectile_of_the_lagged_q_of_logged_actions() -> None:
    dx = torch.linspace(0, 1, 201)
    state = learning(1.5, IqlSettings(expectile=0.9), 200, dx)
    v = state.networks.online["v"]
    assert isinstance(v, Says) and v.outputs.item() == pytest.approx(2 + 0.75, abs=0.01)
    actor, q = state.networks.online["actor"], state.networks.online["q"]
    assert isinstance(actor, Says) and isinstance(q, Product)
    assert not bool(actor.outputs.any()) and q.factor.item() == -5.0, "no actor is trained unless it acts"


def test_the_actor_clones_logged_actions_by_the_exponential_of_their_advantage() -> None:
    dx = torch.tensor([-0.8, 0.6])
    settings = IqlSettings(policy="actor", sharpness=1.0, expectile=0.5)
    state = learning(1.9, settings, 600, dx)
    actor = row.action_selection.act(
        Acting(state.networks.online, {}, ACTION),
        ObservedState(torch.zeros(1, 8, 8, 3, dtype=torch.uint8), torch.tensor([2])),
        np.random.default_rng(0),
        CemSettings(),
    )[0]
    # V is the mean of Q, 1.9: advantages -0.7 and 0.7.
    good, bad = np.exp(0.7), np.exp(-0.7)
    assert float(actor[0, 0].detach()) == pytest.approx((0.6 * good - 0.8 * bad) / (good + bad), abs=0.01)
    assert actor[0, 1:].tolist() == pytest.approx([0, 0, 0], abs=0.01)


def test_no_logged_action_weighs_more_than_a_hundred() -> None:
    # Advantages -0.9, 0.3 and 0.6: exp(50 A) is 3e-20, 3e6 and 1e13; capped, the good ones count alike.
    settings = IqlSettings(policy="actor", sharpness=50.0, expectile=0.5)
    state = learning(2.0, settings, 600, torch.tensor([-0.9, 0.3, 0.6]))
    actor = state.networks.online["actor"]
    assert isinstance(actor, Says)
    assert float(pointed(actor.outputs, ACTION)[0].detach()) == pytest.approx(0.45, abs=0.01)


def test_a_run_has_an_actor_only_where_it_acts(settings: Callable[..., TrainSettings], tmp_path: Path) -> None:
    found = {
        policy: set(load_acting(train(settings("iql", out=tmp_path / policy, steps=2, policy=policy)).folder).networks)
        for policy in ("search", "actor")
    }
    assert found == {"search": {"q", "v"}, "actor": {"q", "v", "actor"}}
