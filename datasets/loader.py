"""Endless batches from a pool of shards that may be larger than memory, in the sampler's order.

Blocks are read once per window, and the next window is read bit by bit while one is used; a background thread assembles
the batches ahead. Dimension key: B batch, T steps, H W C image.
"""

import contextlib
import itertools
import os
import queue
import threading
import weakref
from collections.abc import Callable, Iterator
from functools import partial
from types import TracebackType
from typing import Generic, Self, TypeVar

import numpy as np

from graspq.datasets.batch import EpisodeBatch, Int64, TransitionBatch
from graspq.datasets.buffer import BlockBuffer
from graspq.datasets.gather import Blocks, gather_episodes, gather_transitions, located
from graspq.datasets.pool import ShardPool
from graspq.datasets.sampler import Sampler

B = TypeVar("B")
# Blocks in memory, the block of each item, its number within it → the batch.
Gather = Callable[[Blocks, list[int], list[int]], B]
DEFAULT_BUFFER_BYTES = 4 * 2**30


class _Source(Generic[B]):
    """Makes the batches: keeps the blocks of the sampler's window in memory and gathers from them."""

    def __init__(self, pool: ShardPool, sampler: Sampler, gather: Gather[B]) -> None:
        self._sampler, self._gather = sampler, gather
        self.buffer = BlockBuffer(pool)

    def batches(self, start_step: int, every: int) -> Iterator[B]:
        """Yield the batch of every `every`-th global step from `start_step` on, without end."""
        resident: tuple[int, range] | None = None
        for global_step in itertools.count(start_step, every):
            epoch, step = self._sampler.position(global_step)
            touched = self._sampler.windows_of(epoch, step)
            following = self._following(epoch, touched.stop)
            if resident != (epoch, touched):
                windows = self._sampler.windows(epoch)
                needed = np.concatenate([windows[window] for window in touched])
                self.buffer.receive()
                self.buffer.keep({*needed.tolist(), *following.tolist()})
                self.buffer.read(needed)
                resident = epoch, touched
            yield self._gather(
                self.buffer.blocks, *located(self._sampler.item_offsets, self._sampler.indices(epoch, step))
            )
            if len(touched) == 1 and self._sampler.windows_per_epoch > 1:
                self._read_ahead(epoch, step, touched.start, following)

    def _following(self, epoch: int, window: int) -> Int64:
        """Return the blocks of a window, which may be the first of the next epoch."""
        windows = self._sampler.windows(epoch)
        return windows[window] if window < len(windows) else self._sampler.windows(epoch + 1)[0]

    def _read_ahead(self, epoch: int, step: int, window: int, following: Int64) -> None:
        """Ask for so much of the next window that it is there in time, spread evenly over the steps that are left.

        Readers may be one batch behind: neither they nor the gathering wait for the other at every batch.
        """
        missing = self.buffer.missing(following)
        items_left = int(self._sampler.window_borders(epoch)[window + 1]) - (step + 1) * self._sampler.batch_size
        steps_left = max(1, items_left // self._sampler.batch_size)
        now = -(-len(missing) // steps_left)
        self.buffer.receive(but=now)
        self.buffer.ask(missing[:now])


class _Loader(Generic[B]):
    """An endless iterator of batches, assembled ahead by a thread that starts with the first one.

    The thread knows the source and the queue alone: a loader that is dropped without `close` ends its thread.
    """

    def __init__(
        self, pool: ShardPool, sampler: Sampler, gather: Gather[B], start_step: int, every: int, prefetch: int
    ) -> None:
        self.pool, self.sampler = pool, sampler
        self.step, self._every = start_step, every
        self._source = _Source(pool, sampler, gather)
        self._batches = self._source.batches(start_step, every)
        self._queue: queue.Queue[B | BaseException] = queue.Queue(prefetch)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        if prefetch > 0:
            arguments = (self._batches, self._queue, self._stop)
            self._thread = threading.Thread(target=_fill, args=arguments, name="graspq-loader", daemon=True)
        self._process: int | None = None

    @property
    def peak_bytes(self) -> int:
        """Most memory that blocks have taken so far; at most the buffer."""
        return self._source.buffer.peak_bytes

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> B:
        """Return the batch of global step `step`, and advance.

        Raises:
            UserError: a shard is damaged.
            RuntimeError: the process is a fork of the one that took the first batch; threads are not copied.
        """
        if self._stop.is_set():
            raise StopIteration
        self._begin()
        if self._thread is None:
            batch = next(self._batches)
        else:
            received = self._queue.get()
            if isinstance(received, BaseException):
                self.close()
                raise received
            batch = received
        self.step += self._every
        return batch

    def close(self) -> None:
        """Stop reading and free the buffer; closing twice does no harm."""
        self._stop.set()
        if self._process is None or self._process != os.getpid():
            return
        self._source.buffer.cancel()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        self._source.buffer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _begin(self) -> None:
        if self._process is None:
            self._process = os.getpid()
            weakref.finalize(self, self._stop.set)
            if self._thread is not None:
                self._thread.start()
        elif self._process != os.getpid():
            raise RuntimeError(
                f"this loader gave its first batch in process {self._process} and cannot go on in a fork of it; "
                "make the loader in the process that iterates it"
            )


def _fill(batches: Iterator[B], room: "queue.Queue[B | BaseException]", stop: threading.Event) -> None:
    """Put batches into the queue, and what went wrong, until it is told to stop."""

    def put(value: B | BaseException) -> None:
        while not stop.is_set():
            with contextlib.suppress(queue.Full):
                return room.put(value, timeout=0.1)

    try:
        for batch in batches:
            put(batch)
            if stop.is_set():
                return
    except BaseException as error:
        put(error)


class TransitionLoader(_Loader[TransitionBatch]):
    """Endless `TransitionBatch`es of `batch_size` over all ranks; this rank's part of each.

    Args:
        pool: the shards.
        batch_size: samples of a global batch.
        seed: whole number ≥ 0; the order is a function of it, the epoch and the step.
        buffer_bytes: bound on the memory that blocks take; a pool that fits is read once.
        start_step: global step of the first batch: an unbroken run and a resumed one give the same batches.
        rank: this process, 0 .. ranks − 1.
        ranks: number of processes.
        prefetch: batches assembled ahead by the background thread; 0 works without a thread.
        every: global steps from one batch to the next: n processes that share the work take every n-th.
        need_next: also gather s′; where no target reads it, leaving it out halves the copying.

    Raises:
        UserError: the batch is larger than the data, the buffer too small, or (on iterating) a shard is damaged.
    """

    def __init__(
        self,
        pool: ShardPool,
        batch_size: int,
        seed: int,
        buffer_bytes: int = DEFAULT_BUFFER_BYTES,
        start_step: int = 0,
        rank: int = 0,
        ranks: int = 1,
        prefetch: int = 2,
        every: int = 1,
        need_next: bool = True,
    ) -> None:
        rows = buffer_bytes // pool.row_bytes
        sampler = Sampler([ref.rows for ref in pool.blocks], batch_size, seed, rows, rank, ranks)
        super().__init__(pool, sampler, partial(gather_transitions, need_next=need_next), start_step, every, prefetch)


class EpisodeLoader(_Loader[EpisodeBatch]):
    """Endless `EpisodeBatch`es of whole episodes padded to `max_steps`; see `TransitionLoader` for the arguments.

    `max_steps` is the task's T where it is not given.
    """

    def __init__(
        self,
        pool: ShardPool,
        batch_size: int,
        seed: int,
        buffer_bytes: int = DEFAULT_BUFFER_BYTES,
        start_step: int = 0,
        rank: int = 0,
        ranks: int = 1,
        prefetch: int = 2,
        every: int = 1,
        max_steps: int | None = None,
    ) -> None:
        longest = pool.max_steps if max_steps is None else max_steps
        rows = buffer_bytes // pool.row_bytes
        episodes = [ref.episodes for ref in pool.blocks]
        sampler = Sampler(
            [ref.rows for ref in pool.blocks], batch_size, seed, rows, rank, ranks, items_per_block=episodes
        )
        super().__init__(pool, sampler, partial(gather_episodes, max_steps=longest), start_step, every, prefetch)


def transition_batches(pool: ShardPool, batch_size: int, need_next: bool = True) -> Iterator[TransitionBatch]:
    """Yield every row of the pool once, in its order; the last batch may be smaller. For validation."""
    counts = [ref.rows for ref in pool.blocks]
    return _in_order(pool, counts, batch_size, partial(gather_transitions, need_next=need_next))


def episode_batches(pool: ShardPool, batch_size: int, max_steps: int | None = None) -> Iterator[EpisodeBatch]:
    """Yield every episode of the pool once, in its order; the last batch may be smaller. For validation."""
    longest = pool.max_steps if max_steps is None else max_steps
    counts = [ref.episodes for ref in pool.blocks]
    return _in_order(pool, counts, batch_size, partial(gather_episodes, max_steps=longest))


def _in_order(pool: ShardPool, counts: list[int], batch_size: int, gather: Gather[B]) -> Iterator[B]:
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    with contextlib.closing(BlockBuffer(pool)) as buffer:
        for start in range(0, int(offsets[-1]), batch_size):
            owners, numbers = located(offsets, np.arange(start, min(start + batch_size, int(offsets[-1]))))
            buffer.keep(set(owners))
            buffer.read(np.unique(owners))
            yield gather(buffer.blocks, owners, numbers)
