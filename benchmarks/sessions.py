"""Trainings as parts of a benchmark: sessions with default options, and batches that lie ready in memory."""

import contextlib
import itertools
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from graspq.datasets.pool import ShardPool
from graspq.train.batch import Batch
from graspq.train.batches import training_batches
from graspq.train.session import Session, session
from graspq.train.settings import Preset, complete

CPU = torch.device("cpu")
B = TypeVar("B")


@contextlib.contextmanager
def training_of(
    algo: str, shards: Sequence[str], pool: ShardPool, preset: Preset = "default", **options: Any
) -> Iterator[Session]:
    """Give a new training in a temporary folder, on all but a twentieth of the pool that was opened from the shards."""
    with tempfile.TemporaryDirectory(prefix="graspq-training-") as folder:
        given = {"algo": algo, "shards": tuple(shards), "out": Path(folder) / "run", "device": "cpu", **options}
        # The actor of ddpg is at work in most of a training, but for its rest at the start.
        given |= {"actor_rest": 0.0} if algo == "ddpg" else {}
        with session(complete(given, preset).for_grasps(pool.episodes), pool, *pool.split(0.05, 0)) as current:
            yield current


@contextlib.contextmanager
def batches_of(current: Session, pool: ShardPool) -> Iterator[Iterator[Batch]]:
    """Give the batches that a training takes from a pool, from its step on."""
    with training_batches(pool, current.settings, CPU, current.state.step) as batches:
        yield batches


def ready(current: Session, pool: ShardPool, count: int) -> list[Batch]:
    """Return the first batches of a training."""
    with batches_of(current, pool) as batches:
        return list(itertools.islice(batches, count))


def steps_on(batches: Sequence[B], update: Callable[[B], Mapping[str, Tensor]]) -> Callable[[], None]:
    """Return what takes one step on each batch and waits until it is done; `update` returns the `loss`."""

    def take_steps() -> None:
        for batch in batches:
            measured = update(batch)
        measured["loss"].item()

    return take_steps
