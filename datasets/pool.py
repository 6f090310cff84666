"""What training reads: blocks of one task, image shape, action space and discount, from any number of datasets."""

import functools
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from graspq.common.action_space import ActionSpace
from graspq.common.errors import UserError
from graspq.datasets.blocks import (
    BlockArrays,
    BlockRef,
    read_block,
    read_columns,
    read_episode_rows,
    relabelled,
)
from graspq.datasets.columns import RecordType, record_dtype
from graspq.datasets.episode import Episode

# Attributes of an episode that the episodes table holds as they are.
AS_THEY_ARE = ("episode_id", "block", "seed", "end", "success", "lifted_object", "policy", "exploration")


@dataclass(frozen=True, eq=False)
class ShardPool:
    """Blocks of one or more datasets that agree in task, image shape, action space and discount.

    Attributes:
        blocks: ordered by seed of the dataset, then by number: the order in which they were named does not matter.
        task: the task's settings as JSON.
        image_shape: (H, W, C).
        action: what an action means.
        discount: γ of `mc_return`: the stored one, or that of `with_discount`.
        object_set: `name` and `sha256` of the object set of the first dataset.
        manifest_digest: that of the manifest where the pool is one whole dataset, else that of the shards' digests.
    """

    blocks: tuple[BlockRef, ...]
    task: dict[str, Any]
    image_shape: tuple[int, int, int]
    action: ActionSpace
    discount: float
    object_set: dict[str, Any]
    manifest_digest: str
    _footers: dict[Path, Any] = field(default_factory=dict, repr=False)
    _relabels: bool = field(default=False, repr=False)

    @property
    def action_limits(self) -> tuple[float, ...]:
        """What an action of 1 commands, [A] in the units of `action`."""
        return self.action.limits

    @property
    def rows(self) -> int:
        """Number of steps."""
        return sum(ref.rows for ref in self.blocks)

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return sum(ref.episodes for ref in self.blocks)

    @property
    def max_steps(self) -> int:
        """T, the task's greatest number of steps."""
        return int(self.task["max_steps"])

    @property
    def row_bytes(self) -> int:
        """Memory of one step when it is read."""
        return math.prod(self.image_shape) + self._record.itemsize

    @functools.cached_property
    def _record(self) -> RecordType:
        return record_dtype(self.image_shape, self.action)

    @property
    def folders(self) -> tuple[Path, ...]:
        """Folders of the datasets that the blocks lie in, each once."""
        return tuple(dict.fromkeys(ref.path.absolute().parent.parent for ref in self.blocks))

    def read_block(self, ref: BlockRef) -> BlockArrays:
        """Return the rows of a block; see `blocks.read_block`. Safe to call from several threads."""
        block = read_block(ref, self.image_shape, self._record, self._footers.get(ref.path))
        return relabelled(block, self.discount) if self._relabels else block

    def read_columns(self, ref: BlockRef, names: Sequence[str]) -> dict[str, Any]:
        """Return some stored columns of a block; see `blocks.read_columns`."""
        return read_columns(ref, names, self._footers.get(ref.path))

    def episode(self, ref: BlockRef, number: int) -> Episode:
        """Return episode `number` of a block, counted from 0.

        Raises:
            UserError: a file is missing or damaged.
        """
        block = self.read_block(ref)
        rows = read_episode_rows(ref.path.parent.parent / "episodes" / ref.path.name)
        row = [row for row in rows if row["block"] == ref.block][number]
        first = int(block.first_rows[number])
        steps = slice(first, first + int(block.lengths[number]))
        records = block.records[steps]
        return Episode(
            images=block.images[steps].copy(),
            actions=np.ascontiguousarray(records["action"]),
            rewards=np.ascontiguousarray(records["reward"]),
            gripper_poses=np.ascontiguousarray(records["gripper_pose"]),
            object_ids=tuple(row["object_ids"]),
            object_poses=np.array(row["object_poses"], np.float32).reshape(-1, 7),
            final_pose=np.array(row["final_pose"], np.float32),
            **{name: row[name] for name in AS_THEY_ARE},
        )

    def with_discount(self, discount: float) -> "ShardPool":
        """Return the pool with `mc_return` made from the rewards with γ in [0, 1], where that is not the stored one."""
        return self if discount == self.discount else replace(self, discount=discount, _relabels=True)

    def split(self, validation_fraction: float, seed: int) -> tuple["ShardPool", "ShardPool"]:
        """Return (training, held back): a block is held back with probability `validation_fraction`.

        Whether it is depends on `seed` and the block's identity alone, so it stays so when the dataset is extended or
        moved. A pool of more than one block gives at least one to each side, unless the fraction is 0.

        Raises:
            UserError: the fraction is outside [0, 1).
        """
        if not 0.0 <= validation_fraction < 1.0:
            raise UserError(f"--validation-fraction: expected a number in [0, 1), got {validation_fraction}")
        ranked = sorted(self.blocks, key=lambda ref: _fraction(seed, ref))
        count = sum(_fraction(seed, ref) < validation_fraction for ref in ranked)
        if validation_fraction > 0 and len(ranked) > 1:
            count = min(max(count, 1), len(ranked) - 1)
        elif len(ranked) == 1:
            count = 0
        held_back = set(ranked[:count])
        return (
            replace(self, blocks=tuple(ref for ref in self.blocks if ref not in held_back)),
            replace(self, blocks=tuple(ref for ref in self.blocks if ref in held_back)),
        )


def _fraction(seed: int, ref: BlockRef) -> float:
    """Return a number in [0, 1) that depends on the seed and the block's identity alone."""
    digest = hashlib.sha256(f"held back/{seed}/{ref.key}".encode()).digest()
    return int.from_bytes(digest[:6], "little") / 2**48
