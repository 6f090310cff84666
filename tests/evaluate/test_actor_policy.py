"""The actor's policy: clipped, alone or in a batch the same, with the value that its run can judge by."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from graspq.common.seeding import generator
from graspq.evaluate.actor_policy import ActorPolicy
from graspq.evaluate.policies import Policy
from graspq.train.networks import Features, QNetwork, StateNetwork
from graspq.train.selection import pointed


class FirstPixels(StateNetwork):
    """Outputs that are read off the first pixels."""

    def __init__(self, outputs: int) -> None:
        super().__init__()
        self.outputs = outputs

    def forward(self, image: Tensor, step: Tensor) -> Tensor:
        return image[:, 0, : self.outputs, 0].float() / 127.5 - 1


class Sum(QNetwork):
    """Q(s, a) = Σ a + step."""

    link = "identity"

    def trunk(self, image: Tensor, step: Tensor) -> Features:
        return (step.float(),)

    def head(self, features: Features, action: Tensor) -> Tensor:
        return action.sum(-1) + features[0].unsqueeze(1)


def states(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.integers(0, 256, size=(count, 64, 64, 3), dtype=np.uint8), np.arange(count) % 15


def test_it_acts_where_the_actor_points_inside_the_box_and_tells_q_of_that() -> None:
    images, steps = states(5)
    policy = ActorPolicy({"actor": FirstPixels(4), "q": Sum()}, torch.device("cpu"))
    decision = policy.decide(images, steps, [generator("test", row) for row in range(5)])
    outputs = torch.from_numpy(images[:, 0, :4, 0]).float() / 127.5 - 1
    expected = pointed(outputs).clamp(-1, 1).numpy()
    assert decision.actions.dtype == np.float32 and np.array_equal(decision.actions, expected)
    assert (decision.actions == -1).any(), "the test wants an action beyond the box"
    assert decision.q == pytest.approx(expected.sum(1) + steps, abs=1e-5)


def test_a_distribution_acts_by_its_mean_and_tells_the_value_of_the_state() -> None:
    images, steps = states(3)
    policy = ActorPolicy({"actor": FirstPixels(8), "v": FirstPixels(1)}, torch.device("cpu"))
    decision = policy.decide(images, steps, [None, None, generator("test", 2)])
    alone = ActorPolicy({"actor": FirstPixels(4)}, torch.device("cpu")).decide(images, steps, [None] * 3)
    assert np.array_equal(decision.actions, alone.actions)
    assert decision.q == pytest.approx(images[:, 0, 0, 0] / 127.5 - 1, abs=1e-6)
    assert alone.q is None


@pytest.fixture
def run_of(dataset: Path, tmp_path: Path) -> Callable[[str], Path]:
    from graspq.train.loop import train
    from graspq.train.settings import preset_settings

    def make(algo: str) -> Path:
        settings = preset_settings(
            "paper", algo=algo, shards=(str(dataset),), out=tmp_path / algo, steps=2, batch_size=8,
            validation_fraction=0.25, device="cpu", precision="float32", threads=1,
        )  # fmt: skip
        return train(settings).folder

    return make


@pytest.mark.parametrize("algo", ["ddpg", "pcl"])
def test_a_run_acts_by_its_actor_and_needs_no_noise(run_of: Callable[[str], Path], algo: str) -> None:
    policy = Policy.from_run(run_of(algo))
    assert isinstance(policy, ActorPolicy)
    images, steps = states(4)
    first = policy.decide(images, steps, [generator("a", row) for row in range(4)])
    again = policy.decide(images, steps, [generator("b", row) for row in range(4)])
    assert first.q is not None and again.q is not None
    assert np.array_equal(first.actions, again.actions) and np.array_equal(first.q, again.q)
    assert np.abs(first.actions).max() <= 1 and first.actions[:, 2].max() < -0.9
