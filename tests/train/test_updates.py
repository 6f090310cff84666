"""Which passes of an update and a validation normalise by the batch's statistics: those that are regressed, alone."""

import itertools
from collections.abc import Callable

import pytest
import torch
from torch import nn

from graspq.datasets.dataset import open_shards
from graspq.train.batches import training_batches
from graspq.train.estimators import ESTIMATORS
from graspq.train.loop import session
from graspq.train.settings import TrainSettings

PICKED_AND_JUDGED = ["lagged-q by running", "q by batch", "q by running"]
# Every pass of an update through a network, and whose statistics its batch normalisation uses.
PASSES = {
    "supervised": ["q by batch"],
    "dql": PICKED_AND_JUDGED,
    "mc": ["q by batch"],
    "corr-mc": PICKED_AND_JUDGED,
    "ddpg": ["actor by batch", "lagged-actor by running", "lagged-q by running", "q by batch", "q by running"],
    # The first pass of its actor only notes the batch's statistics in the running ones.
    "pcl": ["actor by batch", "actor by running", "lagged-actor by running", "v by batch"],
    "blend": PICKED_AND_JUDGED,
}


def watch(networks: dict[str, nn.Module]) -> list[str]:
    """Return a list that every pass through a network from now on is added to."""
    passes: list[str] = []
    for name, network in networks.items():

        def note(*_: object, name: str = name, network: nn.Module = network) -> None:
            by_batch = any(module.training for module in network.modules())
            passes.append(f"{name} by {'batch' if by_batch else 'running'}")

        first = next(module for module in network.modules() if isinstance(module, nn.BatchNorm2d))
        first.register_forward_pre_hook(note)
    return passes


@pytest.mark.parametrize("algo", ESTIMATORS)
def test_target_search_and_evaluation_passes_never_use_batch_statistics(
    settings: Callable[..., TrainSettings], algo: str
) -> None:
    # Without averaged networks the trained ones are judged too.
    chosen = settings(algo, steps=2, average_decay=0.0, actor_rest=0.0, actor_every=1, batch_size=8)
    pool = open_shards(chosen.shards)
    training, held_back = pool.split(chosen.validation_fraction, chosen.seed)
    with session(chosen, pool, training, held_back) as current:
        data, device = training.with_discount(current.discount), torch.device("cpu")
        passes = watch(current.state.networks)
        with training_batches(data, chosen, current.estimator, device, 0) as batches:
            for batch in itertools.islice(batches, 2):
                current.update(batch)
                assert sorted(passes) == PASSES[algo]
                passes.clear()
        assert current.validate() is not None
        assert len(passes) >= 2 and all(name.endswith("by running") for name in passes), passes
