"""`grasp-train`: trains one estimator purely off-policy from shards.

The way on: `loop.update` -> `estimator.regression` -> `estimators/<row>.target` -> `targets` and `selection`.
"""

from typing import Any

import click

from graspq.common.options import given_options, with_version
from graspq.train.loop import train
from graspq.train.options import TrainingCommand
from graspq.train.parallel import joined
from graspq.train.settings import complete


@click.command(cls=TrainingCommand)
@with_version
@click.pass_context
def main(context: click.Context, /, **_: Any) -> None:
    """Train a Q-function from shards: `grasp-train --algo mc --shards data/regular-10k`.

    The same command goes on where an earlier one was stopped or killed.

    Several processes train one network with `torchrun --no-python --nproc-per-node 2 grasp-train ...`, each on its part
    of every batch: --batch-size is that of all together. The first alone writes the run folder, which all must see.
    """
    given = given_options(context)
    preset = given.pop("preset", "default")
    settings = complete(given, preset)
    with joined() as ranks:
        if ranks.first:
            click.echo(f"{settings.algo}: {settings.run_folder}", err=True)
        run = train(settings, show_progress=ranks.first, ranks=ranks)
    if ranks.first:
        click.echo(run.summary())
