"""Blocks of a pool in memory, read by threads: what is wanted is asked for ahead, received, and forgotten again."""

import os
from concurrent.futures import Future, ThreadPoolExecutor

from graspq.datasets.batch import Int64
from graspq.datasets.blocks import BlockArrays
from graspq.datasets.gather import Blocks
from graspq.datasets.pool import ShardPool

READERS = min(4, os.cpu_count() or 1)


class BlockBuffer:
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
