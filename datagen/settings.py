"""Settings of `grasp-datagen`, and the part of them that determines the bytes of a dataset."""

import dataclasses
from pathlib import Path
from typing import Any

from graspq.common.options import Settings, parse_count, setting
from graspq.engine import EngineSettings
from graspq.policies.random import RandomPolicy
from graspq.sim.task import EPISODES_PER_BIN

BLOCKS_PER_SHARD = 50


@dataclasses.dataclass(frozen=True)
class DatagenSettings(EngineSettings):
    """Options of `grasp-datagen`."""

    task: str = setting(
        "regular", help="task to collect: regular, targeted, or your own as module:task, whose code is run"
    )
    size: int = setting(
        10_000, help="number of grasps, such as 2500, 10k, 100k or 1M", parse=parse_count, metavar="COUNT", minimum=1
    )
    out: Path | None = setting(None, help="dataset folder; data/<task>-<size> if not given")
    objects: Path | None = setting(
        None, help="folder of an object set; if not given, the task's own, which is made once in the user's cache"
    )
    seed: int = setting(0, help="seed of the dataset; with it every byte is determined", minimum=0)
    descend_probability: float = setting(
        0.9, help="probability that a random action moves straight down (dz = -1)", minimum=0.0, maximum=1.0
    )
    discount: float = setting(1.0, help="discount of the stored mc_return", minimum=0.0, maximum=1.0)

    def folder(self) -> Path:
        """Return the dataset's folder."""
        return self.out if self.out is not None else Path("data") / f"{self.task.replace(':', '.')}-{_short(self.size)}"

    def collection(self) -> "CollectionSettings":
        """Return what determines the bytes."""
        return CollectionSettings(seed=self.seed, descend_probability=self.descend_probability)


@dataclasses.dataclass(frozen=True)
class CollectionSettings(Settings):
    """What, beside task and objects, determines every episode of a dataset.

    Attributes:
        seed: of the dataset.
        descend_probability: of the random policy.
        split: of the object set that fills the bins.
        block_size: episodes that share their objects.
        blocks_per_shard: blocks of a whole shard.
        policy: name of the policy that acts.
    """

    seed: int = 0
    descend_probability: float = 0.9
    split: str = "train"
    block_size: int = EPISODES_PER_BIN
    blocks_per_shard: int = BLOCKS_PER_SHARD
    policy: str = "random"

    def random_policy(self) -> RandomPolicy:
        """Return the policy that acts."""
        return RandomPolicy(self.descend_probability)

    def described(self) -> dict[str, Any]:
        """Return the settings as the manifest holds them."""
        return self.to_json()


def _short(size: int) -> str:
    """Return a size as people write it: 2500, 10k, 1M."""
    if size % 1_000_000 == 0:
        return f"{size // 1_000_000}M"
    return f"{size // 1_000}k" if size >= 10_000 and size % 1_000 == 0 else str(size)
