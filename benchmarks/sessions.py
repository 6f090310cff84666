"""Trainings as parts of a benchmark: sessions with default options, and batches that lie ready in memory."""

import contextlib
import itertools
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from graspq.benchmarks.measuring import TrainingSpeedSettings
from graspq.datasets.pool import ShardPool
from graspq.train.batch import Batch
from graspq.train.batches import training_batches
from graspq.train.loop import Session, session
from graspq.train.settings import complete

CPU = torch.device("cpu")
B = TypeVar("B")


@contextlib.contextmanager
def training_of(algo: str, pool: ShardPool, settings: TrainingSpeedSettings, **options: Any) -> Iterator[Session]:
    """Give a new training with default options in a temporary folder, on all but a twentieth of a pool."""
    with tempfile.TemporaryDirectory(prefix="graspq-training-") as folder:
        given = {"algo": algo, "shards": settings.shards, "out": Path(folder) / "run", "threads": settings.threads}
        # The actor of ddpg is at work in most of a training, but for its rest at the start.
        given |= {"actor_rest": 0.0} if algo == "ddpg" else {}
        training, held_back = pool.split(0.05, 0)
        with session(complete({**given, "device": "cpu", **options}), pool, training, held_back) as current:
            yield current


@contextlib.contextmanager
def batches_of(current: Session, pool: ShardPool) -> Iterator[Iterator[Batch]]:
    """Give the batches that a training takes from a pool, from its step on."""
    pool = pool.with_discount(current.settings.own.chosen_discount(pool.discount))
    target_value = current.settings.row.target_value
    with training_batches(pool, current.settings, target_value, CPU, current.state.step) as batches:
        yield batches


def ready(current: Session, pool: ShardPool, count: int) -> list[Batch]:
    """Return the first batches of a training."""
    with batches_of(current, pool) as batches:
        return list(itertools.islice(batches, count))


def steps_on(batches: Sequence[B], update: Callable[[B], Tensor]) -> Callable[[], None]:
    """Return what takes one step on each batch and waits until it is done; `update` returns the loss."""

    def take_steps() -> None:
        for batch in batches:
            loss = update(batch)
        loss.item()

    return take_steps


def update_of(current: Session) -> Callable[[Batch], Tensor]:
    """Return what takes a step of a training and returns its loss."""
    return lambda batch: current.update(batch)["loss"]
