"""Collects a dataset of tiny shards by grasp-datagen's own code: `small_dataset.py SIZE OUT OBJECTS`."""

import sys
from dataclasses import dataclass
from pathlib import Path

from graspq.datagen.making import make_dataset
from graspq.datagen.settings import CollectionSettings, DatagenSettings


@dataclass(frozen=True)
class SmallDatagenSettings(DatagenSettings):
    """Two blocks of four grasps a shard, not fifty of twenty."""

    def collection(self) -> CollectionSettings:
        """Return what determines the bytes."""
        return CollectionSettings(seed=self.seed, block_size=4, blocks_per_shard=2)


if __name__ == "__main__":
    size, out, objects = sys.argv[1:]
    make_dataset(SmallDatagenSettings(size=int(size), out=Path(out), objects=Path(objects), workers=0))
