"""Which shards a dataset of a given size has, which of them are missing, and what that will cost."""

import dataclasses
import shutil
from pathlib import Path

from graspq.common.errors import UserError
from graspq.datagen.settings import CollectionSettings
from graspq.datagen.workers import BlockJob
from graspq.datasets.manifest import Manifest

# Measured with the default task on a 2-core machine (README, "What a grasp costs"); for the forecast alone.
BYTES_PER_GRASP = 3_600
GRASPS_PER_SECOND_AND_CORE = 14.0
_SPARE_BYTES = 64 * 2**20


@dataclasses.dataclass(frozen=True)
class ShardPlan:
    """A shard to collect: a fixed run of blocks, of which only the dataset's last may be short."""

    first_block: int
    jobs: tuple[BlockJob, ...]

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return sum(job.episodes for job in self.jobs)


def plan_shards(settings: CollectionSettings, size: int) -> list[ShardPlan]:
    """Return all shards of a dataset of `size` episodes; a larger dataset begins with the same blocks."""
    block_size, per_shard = settings.block_size, settings.blocks_per_shard
    blocks = -(-size // block_size)
    jobs = [BlockJob(block, min(block_size, size - block * block_size)) for block in range(blocks)]
    return [ShardPlan(start, tuple(jobs[start : start + per_shard])) for start in range(0, blocks, per_shard)]


def missing_shards(plan: list[ShardPlan], manifest: Manifest) -> list[ShardPlan]:
    """Return the shards of the plan that the manifest does not list in that length yet.

    A listed shard that is at least as long stays: a folder never shrinks.
    """
    have = {entry.first_block: entry.episodes for entry in manifest.shards}
    return [shard for shard in plan if have.get(shard.first_block, 0) < shard.episodes]


def check_disk(folder: Path, grasps: int) -> None:
    """Check that the disk has room for `grasps` more.

    Raises:
        UserError: the disk has less than that free, with a tenth and 64 MiB to spare.
    """
    expected = grasps * BYTES_PER_GRASP
    free = shutil.disk_usage(folder).free
    if free < expected * 1.1 + _SPARE_BYTES:
        raise UserError(
            f"{folder}: {grasps:,} grasps take about {human_bytes(expected)}, the disk has {human_bytes(free)} free; "
            "free some space, choose another folder or a smaller size"
        )


def human_bytes(count: float) -> str:
    """Return bytes as people read them: `35.2 MB`."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} B" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"


def human_time(seconds: float) -> str:
    """Return a duration as people read it: `12 min`, `20.3 h`."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
