"""Which shards a dataset of a given size has, which of them are missing, and what that will cost."""

import shutil
from collections.abc import Container, Sequence
from pathlib import Path

from graspq.common.errors import UserError
from graspq.common.text import bytes_text
from graspq.datagen.collect import Block
from graspq.datagen.settings import CollectionSettings
from graspq.datasets.manifest import Manifest

# Measured with the default task on a 2-core machine (README, "What a grasp costs"); for the forecast alone.
BYTES_PER_GRASP = 5_600
GRASPS_PER_SECOND_AND_CORE = 14.0
_SPARE_BYTES = 64 * 2**20


# A shard is a fixed run of blocks, of which only the dataset's last may be short.
Shard = tuple[Block, ...]


def episodes_of(shards: Sequence[Shard]) -> int:
    """Return the number of episodes of some shards."""
    return sum(block.episodes for shard in shards for block in shard)


def plan_shards(settings: CollectionSettings, size: int) -> list[Shard]:
    """Return all shards of a dataset of `size` episodes; a larger dataset begins with the same blocks."""
    starts = range(0, size, settings.block_size)
    blocks = [Block(number, min(settings.block_size, size - start), start) for number, start in enumerate(starts)]
    per_shard = settings.blocks_per_shard
    return [tuple(blocks[first : first + per_shard]) for first in range(0, len(blocks), per_shard)]


def missing_shards(plan: Sequence[Shard], manifest: Manifest, damaged: Container[int] = ()) -> list[Shard]:
    """Return the shards of the plan that the manifest does not list in that length yet, or that are damaged.

    A listed shard that is at least as long stays: a folder never shrinks.

    Args:
        plan: all shards.
        manifest: of the dataset.
        damaged: first blocks of shards that are to be made again.
    """
    have = {entry.first_block: entry.episodes for entry in manifest.shards if entry.first_block not in damaged}
    return [shard for shard in plan if have.get(shard[0].number, 0) < episodes_of([shard])]


def check_disk(folder: Path, grasps: int) -> None:
    """Check that the disk has room for `grasps` more.

    Raises:
        UserError: the disk has less than that free, with a tenth and 64 MiB to spare.
    """
    expected = grasps * BYTES_PER_GRASP
    free = shutil.disk_usage(folder).free
    if free < expected * 1.1 + _SPARE_BYTES:
        raise UserError(
            f"{folder}: {grasps:,} grasps take about {bytes_text(expected)}, the disk has {bytes_text(free)} free; "
            "free some space, choose another folder or a smaller size"
        )
