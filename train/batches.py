"""Where a run's batches come from: streamed from the shards, or gathered from a pool that lies on the device.

Both give the same batches in the same order, bit for bit.
"""

import contextlib
import dataclasses
import itertools
from collections.abc import Iterator

import torch

from graspq.datasets.pool import ShardPool
from graspq.train.batch import Batch, to_tensors
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
    pool, target_value, resident = _with_returns(pool, settings), settings.estimator.target_value, settings.resident
    weight = settings.last_step_weight
    # Of a pool on the device the loader gives the order alone, and reads nothing.
    with pool.batches(
        batch_items(pool, settings),
        settings.seed,
        view=target_value.view,
        buffer_bytes=settings.buffer_bytes,
        start_step=start_step,
        rank=ranks.rank,
        ranks=ranks.count,
        prefetch=0 if resident else 2,
        need_next=target_value.needs_next,
        last_step_weight=weight,
    ) as loader:
        batches: Iterator[Batch]
        if resident:
            held, sampler = ResidentPool.read(pool, device, weight), loader.sampler
            indices = (sampler.indices(*sampler.position(step)) for step in itertools.count(start_step))
            if target_value.view == "episodes":
                batches = (held.episodes(index) for index in indices)
            else:
                batches = (held.transitions(index, target_value.needs_next) for index in indices)
        else:
            batches = (to_tensors(batch, device) for batch in loader)
        # Whole episodes hold a last step as often as any other: there it weighs more. With weight 1 the mean is
        # the plain one, to the last bit.
        weighs = target_value.view == "episodes" and weight > 1
        yield (_weighted(batch, weight) for batch in batches) if weighs else batches


def _weighted(batch: Batch, last_step_weight: int) -> Batch:
    return dataclasses.replace(batch, weight=1.0 + (last_step_weight - 1) * batch.terminal.float())


def batch_items(pool: ShardPool, settings: TrainSettings) -> int:
    """Return the items of a batch over all ranks: `batch_size` transitions, or episodes with so many on average.

    An estimator of whole episodes may count these instead; a batch is never larger than the pool's episodes.
    """
    if settings.estimator.target_value.view == "transitions":
        return settings.batch_size
    if settings.own.counts_episodes:
        return min(settings.batch_size, max(pool.episodes, 1))
    return max(1, min(round(settings.batch_size * pool.episodes / max(pool.rows, 1)), pool.episodes))


def _with_returns(pool: ShardPool, settings: TrainSettings) -> ShardPool:
    """Return the pool with returns of the run's discount, where the target reads them."""
    if not settings.estimator.target_value.needs_return:
        return pool
    return pool.with_discount(settings.own.chosen_discount(pool.discount))


def held_back_batches(held_back: ShardPool, settings: TrainSettings, device: torch.device) -> Iterator[Batch]:
    """Yield the batches of a validation: the first blocks that have at most `VALIDATION_ROWS` rows."""
    held_back, target_value = _with_returns(held_back, settings), settings.estimator.target_value
    rows = itertools.accumulate(ref.rows for ref in held_back.blocks)
    kept = sum(1 for total in rows if total <= VALIDATION_ROWS)
    pool = dataclasses.replace(held_back, blocks=held_back.blocks[: max(kept, 1)])
    batches = pool.once(batch_items(pool, settings), view=target_value.view, need_next=target_value.needs_next)
    yield from (to_tensors(batch, device) for batch in batches)
