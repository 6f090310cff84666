"""A pool of shards that lies on the training device as a whole, images as one uint8 tensor: batches cost one gather.

Dimensions: N rows of the pool, E episodes, B batch, T steps, H W C image.
"""

import dataclasses
import math
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from torch import Tensor

from graspq.common.errors import UserError
from graspq.datasets.blocks import BlockArrays
from graspq.datasets.episode import Int64
from graspq.datasets.loader import READERS
from graspq.datasets.pool import ShardPool
from graspq.train.batch import SOURCES, Batch


def image_bytes(pool: ShardPool) -> int:
    """Return the memory of a pool's images."""
    return pool.rows * math.prod(pool.image_shape)


@dataclasses.dataclass(frozen=True, eq=False)
class ResidentPool:
    """All rows of a pool, in its order.

    Attributes:
        image: uint8 [N, H, W, C].
        row: int64 [items], the row of each item; on the CPU. See `BlockArrays.row_of`.
        columns: the other columns of the data by name, [N, ...]; see `Batch` for their types.
        first_row: int64 [E], the first row of each episode.
        length: int64 [E], steps of each; on the CPU.
    """

    image: Tensor
    row: Int64
    columns: dict[str, Tensor]
    first_row: Tensor
    length: Int64

    @classmethod
    def read(cls, pool: ShardPool, device: torch.device, last_step_weight: int = 1) -> "ResidentPool":
        """Read all blocks of a pool onto a device; `last_step_weight` as in `ShardPool.batches`.

        Raises:
            UserError: the images do not fit, or a shard is damaged.
        """
        try:
            image = torch.empty(pool.rows, *pool.image_shape, dtype=torch.uint8, device=device)
        except RuntimeError:
            raise UserError(
                f"--resident: {image_bytes(pool) / 2**30:.1f} GiB of images do not fit on {device}; leave it out"
            ) from None
        blocks: list[BlockArrays] = []
        rows: list[Int64] = []
        row = 0
        with ThreadPoolExecutor(READERS) as executor:
            for block in executor.map(pool.read_block, pool.blocks):
                # A copy: what Arrow read is read-only, which torch does not know.
                image[row : row + len(block.images)] = torch.from_numpy(block.images.copy()).to(device)
                rows.append(row + np.arange(len(block.images)))
                rows += [row + np.array(block.last_rows)] * (last_step_weight - 1)
                row += len(block.images)
                blocks.append(dataclasses.replace(block, images=block.images[:0].copy()))

        def tensor(array: Any) -> Tensor:
            return torch.from_numpy(array.copy()).to(device)

        records = np.concatenate([block.records for block in blocks])
        length = np.concatenate([block.lengths for block in blocks])
        columns = {name: tensor(records[name]) for name in records.dtype.names or () if name not in SOURCES}
        return cls(image, np.concatenate(rows), columns, tensor(np.cumsum(length) - length), length)

    def transitions(self, items: Int64, need_next: bool) -> Batch:
        """Return the transitions of items, int64 [B], as `to_tensors` gives those of a `TransitionBatch`."""
        index = torch.from_numpy(self.row[items]).to(self.image.device)
        columns = {name: column[index].unsqueeze(1) for name, column in self.columns.items()}
        batch = Batch.of({"image": self.image[index].unsqueeze(1), **columns})
        if not need_next:
            return batch
        # A terminal row has no s': its own image stands there, and no target reads it.
        onward = (~batch.terminal).long()
        next_image = self.image[index + onward.squeeze(1)].unsqueeze(1)
        return dataclasses.replace(batch, next_image=next_image, next_step=batch.step + onward)

    def episodes(self, numbers: Int64) -> Batch:
        """Return episodes, int64 [B], padded to the longest, as `to_tensors` gives those of an `EpisodeBatch`."""
        device, length = self.image.device, self.length[numbers]
        step = torch.arange(int(length.max()), device=device).expand(len(numbers), -1)
        mask = step < torch.from_numpy(length).to(device).unsqueeze(1)
        row = torch.where(mask, self.first_row[torch.from_numpy(numbers).to(device)].unsqueeze(1) + step, 0)

        def padded(values: Tensor) -> Tensor:
            return values[row] * mask.view(*mask.shape, *[1] * (values.dim() - 1)).to(values.dtype)

        columns = {name: padded(column) for name, column in self.columns.items()}
        return Batch.of({**columns, "image": padded(self.image), "step": step.contiguous(), "mask": mask})
