"""`grasp-datagen`: collects random-policy grasps into a dataset."""

import click

from graspq.common.options import Command, options_from, with_version
from graspq.datagen.settings import DatagenSettings


@click.command(cls=Command)
@with_version
@options_from(DatagenSettings)
def main(settings: DatagenSettings) -> None:
    """Collect random-policy grasps into a dataset of sharded Parquet files.

    Interrupted in any way, the same command goes on where it was. A larger --size extends a smaller dataset in the same
    folder. The same settings give the same bytes, whatever the engine and the number of workers.
    """
    # Imported late: --help must not wait for the simulator.
    from graspq.datagen.making import make_dataset

    make_dataset(settings)
