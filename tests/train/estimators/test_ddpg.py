"""The actor's gradient on Q-functions whose slope is known, the lagged target, and an actor that climbs to the top.

That actor and critic reach the best policy of a known decision process stands in `test_learning`.
"""

import itertools
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from plain import ACTION, plain_networks
from torch import Tensor, nn

from graspq.train.batch import Batch
from graspq.train.checkpoint import load_acting
from graspq.train.estimators.ddpg import DdpgSettings, target, uphill
from graspq.train.loop import train
from graspq.train.networks.network import Features, QNetwork, StateNetwork
from graspq.train.selection import pointed
from graspq.train.settings import TrainSettings
from graspq.train.state import seeded


class Says(StateNetwork):
    """An actor that points the same way in every state."""

    def __init__(self, *direction: float) -> None:
        super().__init__()
        # The inverse of `pointed`.
        start, wanted = torch.tensor([0.0, 0.0, -1.0, 0.0]) / 1.25, torch.tensor(direction) / 1.25
        self.output = nn.Parameter(wanted * (1 - wanted**2).rsqrt() - start * (1 - start**2).rsqrt())

    def forward(self, image: Tensor, step: Tensor) -> Tensor:
        return self.output.expand(len(image), -1)


class Product(QNetwork):
    """Q(s, a) = factor · dx + step."""

    link = "identity"

    def __init__(self, factor: float) -> None:
        super().__init__()
        self.factor = factor

    def trunk(self, image: Tensor, step: Tensor) -> Features:
        return (step.float(),)

    def head(self, features: Features, action: Tensor) -> Tensor:
        return self.factor * action[..., 0] + features[0].unsqueeze(1)


def batch(**changes: Tensor | None) -> Batch:
    image = torch.zeros(2, 1, 8, 8, 3, dtype=torch.uint8)
    values: dict[str, Tensor | None] = {
        "image": image,
        "step": torch.tensor([[0], [3]]),
        "action": torch.zeros(2, 1, 4),
        "reward": torch.tensor([[0.0], [1.0]]),
        "terminal": torch.tensor([[False], [True]]),
        "mc_return": torch.zeros(2, 1),
        "synthetic_action": torch.zeros(2, 1, 4),
        "next_image": image,
        "next_step": torch.tensor([[1], [4]]),
    }
    return Batch(**values | changes)  # type: ignore[arg-type]


def test_an_output_of_zero_points_straight_down_and_no_output_points_far_outside_the_box() -> None:
    torch.testing.assert_close(pointed(torch.zeros(1, 4), ACTION), torch.tensor([[0.0, 0.0, -1.0, 0.0]]))
    assert float(pointed(torch.full((1, 4), 1e6), ACTION).abs().max()) < 1.25001


def test_the_target_judges_the_lagged_actors_action_by_the_lagged_critic_and_clips_it() -> None:
    networks = plain_networks(
        {"q": Product(-50.0), "actor": Says(-0.5, 0.0, 0.0, 0.0)},
        {"q": Product(2.0), "actor": Says(1.2, 0.0, 0.0, 0.0)},
    )
    found = target(batch(), networks, DdpgSettings(), seeded("tests/draws"), 0.0)
    torch.testing.assert_close(found, torch.tensor([[0.9 * (2.0 + 1.0)], [1.0]]))
    with pytest.raises(ValueError, match="needs_next=True"):
        target(batch(next_image=None), networks, DdpgSettings(), seeded("tests/draws"), 0.0)


def test_the_gradient_is_the_slope_of_q_clipped_and_turns_back_beyond_the_bounds_of_the_box() -> None:
    slope = torch.tensor([0.25, -7.0, -0.5, 0.5])

    def q_of_actions(action: Tensor) -> Tensor:
        return (action * slope).sum(-1)

    direction = torch.tensor([[0.0, 0.0, 0.0, 0.0], [0.9, 0.9, -1.0, 1.1], [-1.2, -1.0, 1.2, -1.1]])
    expected = torch.tensor([[0.25, -1.0, -0.5, 0.5], [0.25, -1.0, 0.0, -0.2], [0.25, 0.0, -0.5, 0.5]])
    torch.testing.assert_close(uphill(q_of_actions, direction), expected, rtol=0, atol=1e-6)


def test_the_slope_is_taken_where_the_clipped_action_is() -> None:
    gradient = uphill(lambda action: -0.1 * action.square().sum(-1), torch.tensor([[1.2, 0.0, 0.5, -1.1]]))
    torch.testing.assert_close(gradient, torch.tensor([[-0.2, 0.0, -0.1, 0.2]]))


def test_the_critics_weights_change_by_its_own_regression_alone(
    settings: Callable[..., TrainSettings], tmp_path: Path
) -> None:
    plain = {"steps": 1, "discount": 0.0, "warmup": 0.0, "average_decay": 0.0}
    critics = [
        load_acting(train(settings(algo, out=tmp_path / algo, **plain)).folder).networks["q"].state_dict()
        for algo in ("ddpg", "dql")
    ]
    # With discount 0 both regress onto the reward: only then are their critics the same.
    assert all(torch.equal(critics[0][name], critics[1][name]) for name in critics[0])


def test_the_actor_rests_for_its_part_of_the_steps_and_then_moves(
    settings: Callable[..., TrainSettings], tmp_path: Path
) -> None:
    short = {"preset": "paper", "steps": 4, "save_every": 1}
    run = train(settings("ddpg", out=tmp_path / "run", actor_rest=0.5, **short), stop_at=3).folder
    actors = [load_acting(run, step).networks["actor"].state_dict() for step in (1, 2, 3)]
    same = [all(torch.equal(actors[0][name], other[name]) for name in other) for other in actors[1:]]
    assert same == [True, False]


def test_the_actor_takes_a_step_after_as_many_steps_of_q_as_it_is_told(
    settings: Callable[..., TrainSettings],
) -> None:
    chosen = settings("ddpg", preset="paper", steps=5, save_every=1, actor_rest=0.0, actor_every=2)
    states = []
    for step in (1, 2, 3, 4):
        states.append(load_acting(train(chosen, stop_at=step).folder, step).networks)
    changed = {
        part: [
            any(
                not torch.equal(before[part].state_dict()[name], value)
                for name, value in after[part].state_dict().items()
            )
            for before, after in itertools.pairwise(states)
        ]
        for part in ("actor", "q")
    }
    assert changed == {"actor": [False, True, False], "q": [True, True, True]}


@pytest.mark.parametrize(("top", "reached"), [(0.4, 0.4), (3.0, 1.0)])
def test_an_actor_that_follows_the_gradient_ends_at_the_top_or_at_the_bound_before_it(
    top: float, reached: float
) -> None:
    actor = Says(0.0, 0.0, -1.0, 0.0)
    optimizer = torch.optim.AdamW(actor.parameters(), lr=0.01, weight_decay=0.0)
    image, step = torch.zeros(3, 8, 8, 3, dtype=torch.uint8), torch.zeros(3, dtype=torch.int64)
    for _ in range(400):
        direction = pointed(actor(image, step), ACTION)
        gradient = uphill(lambda action: -(action[..., 0] - top).square(), direction.detach())
        optimizer.zero_grad()
        (-(gradient * direction).sum(-1).mean()).backward()
        optimizer.step()
    action = pointed(actor(image, step), ACTION).clamp(-1, 1)
    torch.testing.assert_close(action, torch.tensor([[reached, 0.0, -1.0, 0.0]]).expand(3, -1), rtol=0, atol=1e-3)
    assert float(direction.detach().abs().max()) < 1.25
