"""graspq: an open benchmark for vision-based robotic grasping with off-policy Q-function estimators.

The folders beside this one are its subpackages (`objects/` is `graspq.objects`, and so on); importing graspq itself
registers the Gymnasium environments by name only, so PyBullet is not imported until one of them is made.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from gymnasium.envs.registration import register

if TYPE_CHECKING:
    from graspq.datasets.pool import ShardPool

__version__ = "0.1.0"

register(id="graspq/Grasping-v0", entry_point="graspq.sim.environments:Grasping")
register(id="graspq/RegularGrasping-v0", entry_point="graspq.sim.environments:Grasping", kwargs={"task": "regular"})
register(id="graspq/TargetedGrasping-v0", entry_point="graspq.sim.environments:Grasping", kwargs={"task": "targeted"})


def open(*shards: str | Path, verify: bool = True) -> "ShardPool":
    """Open datasets to train on: `graspq.open("data/regular-10k").batches(batch_size=256)`.

    Args:
        shards: dataset folders, shard files, or globs of either; they must fit together.
        verify: check the SHA-256 of every file now; page checksums are verified on each read anyway.

    Raises:
        UserError: something is no dataset or is damaged, or the datasets do not fit together.
    """
    from graspq.datasets.dataset import open_shards

    return open_shards(shards, verify)
