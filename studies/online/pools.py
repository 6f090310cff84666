"""What is trained on in each round: the base pool's training part, and the blocks of the rounds so far.

Blocks that were read are kept from round to round where all fit the buffer: only what is new is read.
"""

import dataclasses
from pathlib import Path

from graspq.datasets.blocks import BlockArrays, BlockRef
from graspq.datasets.pool import ShardPool


@dataclasses.dataclass(frozen=True, eq=False)
class KeepingPool(ShardPool):
    """A pool that keeps the blocks it has read.

    Attributes:
        kept: (file, row group) → block; shared with the pools that were made from this one.
    """

    kept: dict[tuple[Path, int], BlockArrays] = dataclasses.field(default_factory=dict, repr=False)

    def read_block(self, ref: BlockRef) -> BlockArrays:
        """Return the rows of a block; see `ShardPool.read_block`."""
        key = ref.path, ref.row_group
        if key not in self.kept:
            self.kept[key] = super().read_block(ref)
        return self.kept[key]


class PoolOfRounds:
    """Makes the pool of each round.

    Args:
        base: training part of the base pool.
        buffer_bytes: memory that blocks may take.
    """

    def __init__(self, base: ShardPool, buffer_bytes: int) -> None:
        fields = [field.name for field in dataclasses.fields(base)]
        self._keeping = KeepingPool(**{name: getattr(base, name) for name in fields})
        self._base, self._buffer_rows = base, buffer_bytes // base.row_bytes

    def of(self, blocks: tuple[BlockRef, ...]) -> ShardPool:
        """Return the base pool with these blocks after its own; the order of samples is a function of both."""
        every = (*self._base.blocks, *blocks)
        if sum(ref.rows for ref in every) <= self._buffer_rows:
            return dataclasses.replace(self._keeping, blocks=every)
        self._keeping.kept.clear()
        return dataclasses.replace(self._base, blocks=every)
