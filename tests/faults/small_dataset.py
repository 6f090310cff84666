"""Collects a dataset of tiny shards by grasp-datagen's own code: `small_dataset.py SIZE OUT OBJECTS`."""

from dataclasses import dataclass
from pathlib import Path

import click

from graspq.common.options import Command
from graspq.datagen.settings import CollectionSettings, DatagenSettings


@dataclass(frozen=True)
class SmallDatagenSettings(DatagenSettings):
    """Two blocks of four grasps a shard, not fifty of twenty."""

    def collection(self) -> CollectionSettings:
        """Return what determines the bytes."""
        return CollectionSettings(seed=self.seed, block_size=4, blocks_per_shard=2)


@click.command(cls=Command)
@click.argument("size", type=int)
@click.argument("out", type=click.Path(path_type=Path))
@click.argument("objects", type=click.Path(path_type=Path))
def main(size: int, out: Path, objects: Path) -> None:
    """Collect it."""
    # Imported late, as grasp-datagen does: a Ctrl-C meanwhile is the command's to answer.
    from graspq.datagen.making import make_dataset

    make_dataset(SmallDatagenSettings(size=size, out=out, objects=objects, workers=0))


if __name__ == "__main__":
    main()
