"""Endless batches from a pool of shards that may be larger than memory, in the sampler's order.

Blocks are read once per window, and the next window is read bit by bit while one is used; a background thread assembles
the batches ahead. Dimension key: B batch, T steps, H W C image.
"""

import contextlib
import itertools
import os
import queue
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Generic, Self, TypeVar

import numpy as np

from graspq.datasets.batch import EpisodeBatch, Int64, TransitionBatch
from graspq.datasets.blocks import BlockArrays
from graspq.datasets.gather import Blocks, gather_episodes, gather_transitions, located
from graspq.datasets.pool import ShardPool
from graspq.datasets.sampler import Sampler

B = TypeVar("B")
READERS = min(4, os.cpu_count() or 1)
DEFAULT_BUFFER_BYTES = 4 * 2**30


class _Buffer:
    """The blocks in memory, by their index in the pool, and those that are being read."""

    def __init__(self, pool: ShardPool) -> None:
        self._pool = pool
        self._readers = ThreadPoolExecutor(READERS, "graspq-reader")
        self._asked: dict[int, Future[BlockArrays]] = {}
        self.blocks: Blocks = {}
        self.bytes = self.peak_bytes = 0

    def missing(self, wanted: Int64) -> list[int]:
        """Return which blocks are neither here nor asked for."""
        return [index for index in wanted.tolist() if index not in self.blocks and index not in self._asked]

    def ask(self, indices: list[int]) -> None:
        """Let the readers begin with some blocks."""
        for index in indices:
            self._asked[index] = self._readers.submit(self._pool.read_block, self._pool.blocks[index])

    def receive(self, but: int = 0) -> None:
        """Wait for the blocks that were asked for, but for the last few.

        Raises:
            UserError: one is damaged.
        """
        for index in list(self._asked)[: max(0, len(self._asked) - but)]:
            block = self._asked[index].result()
            self.blocks[index] = block
            del self._asked[index]
            self.bytes += block.bytes
            self.peak_bytes = max(self.peak_bytes, self.bytes)

    def read(self, wanted: Int64) -> None:
        """Wait until all of these blocks are here."""
        self.ask(self.missing(wanted))
        self.receive()

    def keep(self, wanted: set[int]) -> None:
        """Forget all blocks but these."""
        for index in self.blocks.keys() - wanted:
            self.bytes -= self.blocks.pop(index).bytes

    def cancel(self) -> None:
        """Begin no further block; whoever waits for one gets `CancelledError`."""
        self._readers.shutdown(wait=False, cancel_futures=True)

    def close(self) -> None:
        """Stop the readers and forget all blocks."""
        self._readers.shutdown(cancel_futures=True)
        self._asked.clear()
        self.keep(set())


class _Loader(Generic[B]):
    """An endless iterator of batches; the subclass says how a batch is gathered from the blocks in memory."""

    def __init__(self, pool: ShardPool, sampler: Sampler, start_step: int, prefetch: int) -> None:
        self.pool, self.sampler = pool, sampler
        self.step = start_step
        self._stop = threading.Event()
        self._buffer = _Buffer(pool)
        self._thread: threading.Thread | None = None
        self._batches = self._produce(start_step)
        if prefetch > 0:
            self._queue: queue.Queue[B | BaseException] = queue.Queue(prefetch)
            self._thread = threading.Thread(target=self._run, name="graspq-loader", daemon=True)
            self._thread.start()

    @property
    def peak_bytes(self) -> int:
        """Most memory that blocks have taken so far; at most the buffer."""
        return self._buffer.peak_bytes

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> B:
        """Return the batch of global step `step`, and advance."""
        if self._stop.is_set():
            raise StopIteration
        if self._thread is None:
            batch = next(self._batches)
        else:
            received = self._queue.get()
            if isinstance(received, BaseException):
                self.close()
                raise received
            batch = received
        self.step += 1
        return batch

    def close(self) -> None:
        """Stop reading and free the buffer; closing twice does no harm."""
        self._stop.set()
        self._buffer.cancel()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        self._buffer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _gather(self, items: Int64) -> B:
        raise NotImplementedError

    def _run(self) -> None:
        try:
            for batch in self._batches:
                if not self._put(batch):
                    return
        except BaseException as error:
            self._put(error)

    def _put(self, value: B | BaseException) -> bool:
        while not self._stop.is_set():
            try:
                self._queue.put(value, timeout=0.1)
                return True
            except queue.Full:
                continue
        return False

    def _produce(self, start_step: int) -> Iterator[B]:
        resident: tuple[int, range] | None = None
        for global_step in itertools.count(start_step):
            epoch, step = self.sampler.position(global_step)
            touched = self.sampler.windows_of(epoch, step)
            following = self._following(epoch, touched.stop)
            if resident != (epoch, touched):
                windows = self.sampler.windows(epoch)
                needed = np.concatenate([windows[window] for window in touched])
                self._buffer.receive()
                self._buffer.keep({*needed.tolist(), *following.tolist()})
                self._buffer.read(needed)
                resident = epoch, touched
            yield self._gather(self.sampler.indices(epoch, step))
            if len(touched) == 1 and self.sampler.windows_per_epoch > 1:
                self._read_ahead(epoch, step, touched.start, following)

    def _following(self, epoch: int, window: int) -> Int64:
        """Return the blocks of a window, which may be the first of the next epoch."""
        windows = self.sampler.windows(epoch)
        return windows[window] if window < len(windows) else self.sampler.windows(epoch + 1)[0]

    def _read_ahead(self, epoch: int, step: int, window: int, following: Int64) -> None:
        """Ask for so much of the next window that it is there in time, spread evenly over the steps that are left.

        Readers may be one batch behind: neither they nor the gathering wait for the other at every batch.
        """
        missing = self._buffer.missing(following)
        items_left = int(self.sampler.window_borders(epoch)[window + 1]) - (step + 1) * self.sampler.batch_size
        steps_left = max(1, items_left // self.sampler.batch_size)
        now = -(-len(missing) // steps_left)
        self._buffer.receive(but=now)
        self._buffer.ask(missing[:now])

    def _located(self, items: Int64) -> tuple[list[int], list[int]]:
        """Return the block, as its index in the pool, and the number within the block of each item."""
        return located(self.sampler.item_offsets, items)


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
        need_next: bool = True,
    ) -> None:
        self._need_next = need_next
        rows = buffer_bytes // pool.row_bytes
        sampler = Sampler([ref.rows for ref in pool.blocks], batch_size, seed, rows, rank, ranks)
        super().__init__(pool, sampler, start_step, prefetch)

    def _gather(self, items: Int64) -> TransitionBatch:
        return gather_transitions(self._buffer.blocks, *self._located(items), self._need_next)


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
        max_steps: int | None = None,
    ) -> None:
        self._max_steps = pool.max_steps if max_steps is None else max_steps
        rows = buffer_bytes // pool.row_bytes
        episodes = [ref.episodes for ref in pool.blocks]
        sampler = Sampler(
            [ref.rows for ref in pool.blocks], batch_size, seed, rows, rank, ranks, items_per_block=episodes
        )
        super().__init__(pool, sampler, start_step, prefetch)

    def _gather(self, items: Int64) -> EpisodeBatch:
        return gather_episodes(self._buffer.blocks, *self._located(items), self._max_steps)


def transition_batches(pool: ShardPool, batch_size: int, need_next: bool = True) -> Iterator[TransitionBatch]:
    """Yield every row of the pool once, in its order; the last batch may be smaller. For validation."""
    counts = [ref.rows for ref in pool.blocks]
    return _in_order(
        pool, counts, batch_size, lambda blocks, owners, rows: gather_transitions(blocks, owners, rows, need_next)
    )


def episode_batches(pool: ShardPool, batch_size: int, max_steps: int | None = None) -> Iterator[EpisodeBatch]:
    """Yield every episode of the pool once, in its order; the last batch may be smaller. For validation."""
    longest = pool.max_steps if max_steps is None else max_steps
    counts = [ref.episodes for ref in pool.blocks]
    return _in_order(
        pool, counts, batch_size, lambda blocks, owners, numbers: gather_episodes(blocks, owners, numbers, longest)
    )


def _in_order(
    pool: ShardPool, counts: list[int], batch_size: int, gather: Callable[[Blocks, list[int], list[int]], B]
) -> Iterator[B]:
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    with contextlib.closing(_Buffer(pool)) as buffer:
        for start in range(0, int(offsets[-1]), batch_size):
            owners, numbers = located(offsets, np.arange(start, min(start + batch_size, int(offsets[-1]))))
            buffer.keep(set(owners))
            buffer.read(np.unique(owners))
            yield gather(buffer.blocks, owners, numbers)
