"""Training steps as parts of a benchmark: the settings, the batches that lie ready, and what trains on them."""

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from torch import Tensor

from graspq.datasets.pool import ShardPool
from graspq.evaluate.settings import Device
from graspq.train.batch import Batch
from graspq.train.batches import training_batches
from graspq.train.loop import Session
from graspq.train.settings import TrainSettings, preset_settings

B = TypeVar("B")


def default_settings(
    algo: str, shards: tuple[str, ...], out: Path, threads: int | None, device: Device = "cpu"
) -> TrainSettings:
    """Return the default settings, without the rest of ddpg's actor, which works in most of a training."""
    return preset_settings("default", algo=algo, shards=shards, out=out, threads=threads, device=device, actor_rest=0.0)


def ready(current: Session, pool: ShardPool, count: int) -> list[Batch]:
    """Return the first batches of a run."""
    pool = pool.with_discount(current.discount)
    with training_batches(pool, current.settings, current.estimator, current.precision.device, 0) as batches:
        return list(itertools.islice(batches, count))


def steps_on(batches: Sequence[B], update: Callable[[B], Tensor]) -> Callable[[], None]:
    """Return what takes one step on each batch and waits until it is done."""

    def run() -> None:
        for batch in batches:
            loss = update(batch)
        loss.item()

    return run
