"""Batches from blocks that may be more than fits in memory: endless in the sampler's order, or once in their own.

Blocks are read once per window, and the next window is read bit by bit while one is used; a background thread assembles
the batches ahead.
"""

import contextlib
import itertools
import os
import queue
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Generic, Self, TypeVar

import numpy as np

from graspq.datasets.blocks import BlockArrays, BlockRef
from graspq.datasets.episode import Int64
from graspq.datasets.sampler import Sampler

B = TypeVar("B")
Read = Callable[[BlockRef], BlockArrays]
# Blocks in memory by number, the block of each item, its number within it → the batch.
Gather = Callable[[dict[int, BlockArrays], list[int], list[int]], B]
DEFAULT_BUFFER_BYTES = 4 * 2**30
READERS = min(4, os.cpu_count() or 1)


class BlockBuffer:
    """The blocks in memory, by their index, and those that threads are reading: asked for ahead, received, forgotten.

    Args:
        read: reads a block; called from several threads.
        refs: all blocks.
    """

    def __init__(self, read: Read, refs: Sequence[BlockRef]) -> None:
        self._read, self._refs = read, refs
        self._readers = ThreadPoolExecutor(READERS, "graspq-reader")
        self._asked: dict[int, Future[BlockArrays]] = {}
        self.blocks: dict[int, BlockArrays] = {}
        self.bytes = self.peak_bytes = 0

    def missing(self, wanted: Iterable[int]) -> list[int]:
        """Return which blocks are neither here nor asked for."""
        return [index for index in wanted if index not in self.blocks and index not in self._asked]

    def ask(self, indices: Iterable[int]) -> None:
        """Let the readers begin with some blocks."""
        for index in indices:
            self._asked[index] = self._readers.submit(self._read, self._refs[index])

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

    def hold(self, needed: Sequence[int], wanted: Sequence[int] = ()) -> None:
        """Forget all blocks but those needed and wanted, and wait until all that are needed are here."""
        self.receive()
        for index in self.blocks.keys() - {*needed, *wanted}:
            self.bytes -= self.blocks.pop(index).bytes
        self.ask(self.missing(needed))
        self.receive()

    def cancel(self) -> None:
        """Begin no further block; whoever waits for one gets `CancelledError`."""
        self._readers.shutdown(wait=False, cancel_futures=True)

    def close(self) -> None:
        """Stop the readers and forget all blocks."""
        self._readers.shutdown(cancel_futures=True)
        self._asked.clear()
        self.hold(())


class Loader(Generic[B]):
    """An endless iterator of batches, assembled ahead by a thread that starts with the first one.

    The thread knows the buffer and the queue alone: a loader that is dropped without `close` ends its thread.

    Args:
        read: reads a block; called from several threads.
        refs: all blocks, in the order that the sampler numbers them in.
        sampler: which items each batch has.
        gather: makes a batch of blocks in memory.
        start_step: global step of the first batch: an unbroken run and a resumed one give the same batches.
        every: global steps from one batch to the next: n processes that share the work take every n-th.
        prefetch: batches assembled ahead by the background thread; 0 works without a thread.
    """

    def __init__(
        self,
        read: Read,
        refs: Sequence[BlockRef],
        sampler: Sampler,
        gather: Gather[B],
        start_step: int = 0,
        every: int = 1,
        prefetch: int = 2,
    ) -> None:
        self.sampler, self.step, self._every = sampler, start_step, every
        self._buffer = BlockBuffer(read, refs)
        self._batches = _sampled(self._buffer, sampler, gather, itertools.count(start_step, every))
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
        return self._buffer.peak_bytes

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
        self._buffer.cancel()
        # A thread that could not be started, for want of memory, has no identity and cannot be waited for.
        if self._thread is not None and self._thread.ident and self._thread is not threading.current_thread():
            self._thread.join()
        self._buffer.close()

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


def _sampled(buffer: BlockBuffer, sampler: Sampler, gather: Gather[B], global_steps: Iterable[int]) -> Iterator[B]:
    """Yield the batches of some global steps; the blocks of the sampler's window are kept in memory."""
    resident: tuple[int, range] | None = None
    for global_step in global_steps:
        epoch, step = sampler.position(global_step)
        touched, windows = sampler.windows_of(epoch, step), sampler.windows(epoch)
        following = (windows[touched.stop] if touched.stop < len(windows) else sampler.windows(epoch + 1)[0]).tolist()
        if resident != (epoch, touched):
            buffer.hold(np.concatenate([windows[window] for window in touched]).tolist(), following)
            resident = epoch, touched
        yield gather(buffer.blocks, *_located(sampler.item_offsets, sampler.indices(epoch, step)))
        if len(touched) == 1 and len(windows) > 1:
            items_left = int(sampler.window_borders(epoch)[touched.stop]) - (step + 1) * sampler.batch_size
            _read_ahead(buffer, following, max(1, items_left // sampler.batch_size))


def _read_ahead(buffer: BlockBuffer, following: list[int], steps_left: int) -> None:
    """Ask for so much of the next window that it is there in time, spread evenly over the steps that are left.

    Readers may be one batch behind: neither they nor the gathering wait for the other at every batch.
    """
    missing = buffer.missing(following)
    now = -(-len(missing) // steps_left)
    buffer.receive(but=now)
    buffer.ask(missing[:now])


def in_order(
    read: Read, refs: Sequence[BlockRef], counts: Sequence[int], batch_size: int, gather: Gather[B]
) -> Iterator[B]:
    """Yield all items once, in the order of the blocks; the last batch may be smaller.

    Args:
        read: reads a block; called from several threads.
        refs: all blocks.
        counts: items of each block.
        batch_size: items of a batch.
        gather: makes a batch of blocks in memory.
    """
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    with contextlib.closing(BlockBuffer(read, refs)) as buffer:
        for start in range(0, int(offsets[-1]), batch_size):
            owners, numbers = _located(offsets, np.arange(start, min(start + batch_size, int(offsets[-1]))))
            buffer.hold(sorted(set(owners)))
            yield gather(buffer.blocks, owners, numbers)


def _located(offsets: Int64, items: Int64) -> tuple[list[int], list[int]]:
    """Return, for each item, its block and its number within that block; `offsets` is the first item of each block."""
    owners = np.searchsorted(offsets, items, side="right") - 1
    return owners.tolist(), (items - offsets[owners]).tolist()
