"""`mc-floor`: the larger of `dql`'s target and the observed return, at the same discount."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import torch
from plain import plain_networks
from torch import Tensor

from graspq.datasets.dataset import open_shards
from graspq.train.batch import Batch
from graspq.train.batches import training_batches
from graspq.train.estimators import dql, mc_floor
from graspq.train.networks.network import Features, QNetwork
from graspq.train.settings import TrainSettings
from graspq.train.state import seeded


class Constant(QNetwork):
    """Q(s, a) = 0.4."""

    link = "identity"

    def trunk(self, image: Tensor, step: Tensor) -> Features:
        return (step.float(),)

    def head(self, features: Features, action: Tensor) -> Tensor:
        return torch.full(action.shape[:2], 0.4)


def test_each_target_is_the_larger_of_the_bootstrapped_one_and_the_return() -> None:
    image = torch.zeros(4, 1, 8, 8, 3, dtype=torch.uint8)
    columns = torch.tensor([[0.0, 0.81], [0.0, 0.1], [1.0, 1.0], [0.0, 0.0]]).unsqueeze(1)
    batch = Batch(
        image=image,
        step=torch.arange(4).unsqueeze(1),
        action=torch.zeros(4, 1, 4),
        reward=columns[..., 0],
        terminal=torch.tensor([[False], [False], [True], [True]]),
        mc_return=columns[..., 1],
        synthetic_action=torch.zeros(4, 1, 4),
        next_image=image,
        next_step=torch.arange(1, 5).unsqueeze(1),
    )
    networks = plain_networks({"q": Constant()}, {"q": Constant()})
    found = mc_floor.target(batch, networks, mc_floor.McFloorSettings(discount=0.9), seeded("tests/draws"), 0.0)
    torch.testing.assert_close(found.squeeze(1), torch.tensor([0.81, 0.36, 1.0, 0.0]))
    bootstrapped = dql.target(batch, networks, dql.DqlSettings(), seeded("tests/draws"), 0.0)
    torch.testing.assert_close(bootstrapped.squeeze(1), torch.tensor([0.36, 0.36, 1.0, 0.0]))


def test_returns_have_the_targets_discount_not_the_datas(
    settings: Callable[..., TrainSettings], two_states: SimpleNamespace, tmp_path: Path
) -> None:
    shards = two_states.dataset(tmp_path / "undiscounted", 6)
    chosen = settings("mc-floor", shards=(str(shards),), discount=0.5)
    with training_batches(open_shards([shards]), chosen, torch.device("cpu"), 0) as batches:
        batch = next(batches)
    going_on = ~batch.terminal & (batch.mc_return > 0)
    assert bool(going_on.any()) and set(batch.mc_return[going_on].tolist()) == {0.5}
