"""The rivals of evaluation do the same job: equal Q in every way of asking, by the same noise."""

from pathlib import Path

import numpy as np
import pytest

from graspq.common.seeding import generator
from graspq.evaluate.q_policy import QPolicy
from graspq.evaluate.settings import CemSettings
from graspq.train.networks import NetworkSpecification, make_network
from graspq.train.state import seeded

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def policy():
    import torch

    network = make_network(NetworkSpecification("paper", (64, 64, 3), 4, 15, "logistic"), seeded("tests/rivals"))
    return QPolicy(network, CemSettings(), torch.device("cpu"))


@pytest.mark.parametrize("way", ["64 tiled copies", "trunk each iteration", "trunk once"])
def test_every_way_of_asking_finds_the_same_action_and_leaves_the_policy_as_it_was(monkeypatch, policy, way):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from rivals import asking

    images = np.random.default_rng(0).integers(0, 256, (2, 64, 64, 3), dtype=np.uint8)
    steps = np.array([0, 3])
    noise = [lambda: generator("tests/rivals", 0), lambda: generator("tests/rivals", 1)]
    network = policy.network
    expected = policy.decide(images, steps, [make() for make in noise])
    found = asking(policy, way).decide(images, steps, [make() for make in noise])
    np.testing.assert_allclose(found.actions, expected.actions, atol=1e-4)
    np.testing.assert_allclose(found.q, expected.q, atol=1e-5)
    assert policy.network is network
