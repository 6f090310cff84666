"""The order of samples, a pure function of (seed, epoch, step): resuming needs no state but the step.

Blocks are permuted and cut into windows that fit the buffer; within a window every block's items are spread evenly, in
random order, so that a batch mixes many blocks.
"""

import functools
from collections.abc import Sequence

import numpy as np

from graspq.common.errors import UserError
from graspq.common.seeding import generator
from graspq.datasets.episode import Int64

# A window holds at least so many blocks where there are so many: a batch of 256 then spans as many (DESIGN, section 3).
MINIMUM_WINDOW_BLOCKS = 64


class Sampler:
    """Batches of item numbers; items are rows or episodes, numbered through all blocks in the pool's order.

    An epoch is a permutation of all items, and what is left after its last whole batch is skipped. All ranks see the
    same global batches: each takes its contiguous part, so that the parts put together are the batch, in order.
    """

    def __init__(
        self,
        rows_per_block: Sequence[int] | Int64,
        batch_size: int,
        seed: int,
        buffer_rows: int,
        rank: int = 0,
        ranks: int = 1,
        *,
        items_per_block: Sequence[int] | Int64 | None = None,
    ) -> None:
        """Plan the windows.

        Args:
            rows_per_block: rows of each block of the pool, which is what the buffer is measured in.
            batch_size: items of a global batch, over all ranks.
            seed: whole number ≥ 0.
            buffer_rows: rows that may be in memory at once. Where all fit there is one window; else a window takes up
                to half, since the next is read while one is used.
            rank: this process, 0 .. ranks − 1.
            ranks: number of processes.
            items_per_block: items of each block, where they are not rows.

        Raises:
            UserError: the batch is larger than the pool, or the buffer too small for enough blocks.
        """
        self.batch_size, self.seed, self.rank, self.ranks = batch_size, seed, rank, ranks
        self._rows = np.asarray(rows_per_block, np.int64)
        self._items = self._rows if items_per_block is None else np.asarray(items_per_block, np.int64)
        self.item_offsets: Int64 = np.concatenate([[0], np.cumsum(self._items)]).astype(np.int64)
        total = int(self._items.sum())
        if not 1 <= batch_size <= total:
            raise UserError(f"batch_size: expected 1 to {total}, the number of samples in the data, got {batch_size}")
        if not 0 <= rank < ranks <= batch_size:
            raise UserError(f"rank {rank} of {ranks}: expected 0 <= rank < ranks <= batch size {batch_size}")
        self.steps_per_epoch = total // batch_size
        self.windows_per_epoch = self._count_windows(buffer_rows)
        # Kept for as many windows and epochs as two neighbouring batches touch.
        self._window_order = functools.lru_cache(3)(self._spread)
        self._plan = functools.lru_cache(2)(self._planned)

    def _count_windows(self, buffer_rows: int) -> int:
        blocks, total = len(self._rows), int(self._rows.sum())
        if total <= buffer_rows:
            return 1
        # The largest blocks decide, so that the number of windows holds for every epoch's permutation.
        largest = np.cumsum(np.sort(self._rows)[::-1])
        per_window = int(np.searchsorted(largest, buffer_rows // 2, side="right"))
        needed = min(MINIMUM_WINDOW_BLOCKS, blocks)
        smallest = np.cumsum(np.sort(self._items))
        while needed < blocks and smallest[needed - 1] < self.batch_size:
            needed += 1
        windows = -(-blocks // max(per_window, 1))
        if per_window < needed or blocks // windows < needed:
            rows = min(total, 2 * int(largest[min(2 * needed, blocks) - 1]))
            raise UserError(
                f"--buffer-bytes: room for {buffer_rows} rows is too little to mix {needed} blocks in a batch; "
                f"give room for {rows} rows, {rows / max(buffer_rows, 1):.1f} times as much"
            )
        return windows

    def position(self, global_step: int) -> tuple[int, int]:
        """Return (epoch, step within it) of the batch number `global_step`, counted from 0 over all epochs."""
        return divmod(global_step, self.steps_per_epoch)

    def windows(self, epoch: int) -> list[Int64]:
        """Return the blocks of each window of an epoch: int64 [blocks], near-equal in number."""
        return self._plan(epoch)[0]

    def window_borders(self, epoch: int) -> Int64:
        """Return int64 [windows + 1], the position in the epoch's order at which each window starts; then the end."""
        return self._plan(epoch)[1]

    def windows_of(self, epoch: int, step: int) -> range:
        """Return which windows of the epoch the global batch takes items from: one, or two at a border."""
        borders = self.window_borders(epoch)
        first, last = step * self.batch_size, (step + 1) * self.batch_size - 1
        start, stop = np.searchsorted(borders, [first, last], side="right")
        return range(int(start) - 1, int(stop))

    def global_indices(self, epoch: int, step: int) -> Int64:
        """Return the item numbers of the whole batch, int64 [batch_size]."""
        if not 0 <= step < self.steps_per_epoch:
            raise ValueError(f"step: expected 0 to {self.steps_per_epoch - 1}, got {step}")
        touched = self.windows_of(epoch, step)
        order = np.concatenate([self._window_order(epoch, window) for window in touched])
        start = step * self.batch_size - int(self.window_borders(epoch)[touched.start])
        return order[start : start + self.batch_size]

    def indices(self, epoch: int, step: int) -> Int64:
        """Return this rank's part of the batch, int64 [about batch_size / ranks]."""
        return np.array_split(self.global_indices(epoch, step), self.ranks)[self.rank]

    def _spread(self, epoch: int, window: int) -> Int64:
        """Return the window's items in an order in which every block's items are evenly spread.

        Item j of a block of n gets the key (πⱼ + uⱼ) / n with π a random permutation of 0 .. n − 1 and u uniform in
        [0, 1); the order is that of the keys. Any stretch that is 1/m of the window thus holds about n/m of each block.
        """
        blocks = self.windows(epoch)[window]
        rng = generator("datasets/order", self.seed, epoch, window)
        counts = self._items[blocks]
        shuffled = rng.random(int(counts.sum()))
        starts = np.repeat(np.cumsum(counts) - counts, counts)
        owner = np.repeat(np.arange(len(blocks)), counts)
        items = np.repeat(self.item_offsets[blocks], counts) + np.arange(len(owner)) - starts
        by_block = items[np.lexsort((shuffled, owner))]
        keys = (np.arange(len(owner)) - starts + rng.random(len(owner))) / counts[owner]
        return by_block[np.argsort(keys, kind="stable")]

    def _planned(self, epoch: int) -> tuple[list[Int64], Int64]:
        order = generator("datasets/blocks", self.seed, epoch).permutation(len(self._rows)).astype(np.int64)
        windows = list(np.array_split(order, self.windows_per_epoch))
        counts = [int(self._items[blocks].sum()) for blocks in windows]
        return windows, np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
