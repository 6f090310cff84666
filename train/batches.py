"""Where a run's batches come from: streamed from the shards, or gathered from a pool that lies on the device.

Both give the same batches in the same order, bit for bit.
"""

import contextlib
import dataclasses
import itertools
from collections.abc import Iterator
from typing import Any

import torch

from graspq.datasets.pool import ShardPool
from graspq.train.batch import Batch, episodes_of_a_batch, to_tensors
from graspq.train.estimator import TargetValue
from graspq.train.parallel import ALONE, Ranks
from graspq.train.resident import ResidentPool
from graspq.train.settings import TrainSettings

VALIDATION_ROWS = 8192


@contextlib.contextmanager
def training_batches(
    pool: ShardPool, settings: TrainSettings, device: torch.device, start_step: int, ranks: Ranks = ALONE
) -> Iterator[Iterator[Batch]]:
    """Give the endless batches of a training, this rank's part of each, from the step `start_step` on.

    Args:
        pool: what to train on.
        settings: of the run; its estimator says whether a batch holds transitions or episodes, and what it reads.
        device: where the batches lie.
        start_step: of the first batch.
        ranks: those that share each batch.

    Raises:
        UserError: a batch is larger than the data, the buffer too small, or a shard is damaged.
    """
    pool, wanted, resident = _with_returns(pool, settings), settings.estimator.target_value, settings.resident
    # Of a pool on the device the loader gives the order alone, and reads nothing.
    with pool.batches(
        batch_rows(pool, settings, wanted),
        settings.seed,
        view=wanted.view,
        buffer_bytes=settings.buffer_bytes,
        start_step=start_step,
        rank=ranks.rank,
        ranks=ranks.count,
        prefetch=0 if resident else 2,
        need_next=wanted.needs_next,
    ) as loader:
        if not resident:
            yield (to_tensors(batch, device) for batch in loader)
            return
        held, sampler = ResidentPool.read(pool, device), loader.sampler
        indices = (sampler.indices(*sampler.position(step)) for step in itertools.count(start_step))
        if wanted.view == "episodes":
            yield (held.episodes(index) for index in indices)
        else:
            yield (held.transitions(index, wanted.needs_next) for index in indices)


def batch_rows(pool: ShardPool, settings: TrainSettings, wanted: TargetValue[Any]) -> int:
    """Return the rows of a batch over all ranks: `batch_size` transitions, or about so many in whole episodes."""
    if wanted.view == "transitions":
        return settings.batch_size
    return episodes_of_a_batch(pool, settings.batch_size)


def _with_returns(pool: ShardPool, settings: TrainSettings) -> ShardPool:
    """Return the pool with returns of the run's discount, where the target reads them."""
    if not settings.estimator.target_value.needs_return:
        return pool
    return pool.with_discount(settings.own.chosen_discount(pool.discount))


def held_back_batches(held_back: ShardPool, settings: TrainSettings, device: torch.device) -> Iterator[Batch]:
    """Yield the batches of a validation: the first blocks that have at most `VALIDATION_ROWS` rows."""
    held_back, wanted = _with_returns(held_back, settings), settings.estimator.target_value
    rows = itertools.accumulate(ref.rows for ref in held_back.blocks)
    kept = sum(1 for total in rows if total <= VALIDATION_ROWS)
    pool = dataclasses.replace(held_back, blocks=held_back.blocks[: max(kept, 1)])
    batches = pool.once(batch_rows(pool, settings, wanted), view=wanted.view, need_next=wanted.needs_next)
    yield from (to_tensors(batch, device) for batch in batches)
