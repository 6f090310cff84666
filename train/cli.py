"""`grasp-train`: trains one estimator purely off-policy from shards.

The way on: `loop.update` -> `estimator.regression` -> `estimators/<row>.target` -> `targets` and `selection`.
"""

from pathlib import Path
from typing import Any

import click

from graspq.common.errors import UserError
from graspq.common.options import flag, given_options, with_version
from graspq.train.loop import train
from graspq.train.options import TrainingCommand, value_of
from graspq.train.parallel import joined
from graspq.train.settings import complete

OF_REPLAY = ("shards", "threads")


class TrainCommand(TrainingCommand):
    """The options of training; to verify a run none of them is required."""

    def groups(self, ctx: click.Context) -> list[tuple[str, list[click.Parameter]]]:
        """Return the groups of options."""
        groups = super().groups(ctx)
        groups[0][1].sort(key=lambda one: one.name == "verify_replay")  # what is asked for least comes last
        if value_of("--verify-replay", ctx.meta.get("words", [])) is not None:
            for one in groups[0][1]:
                one.required = False
        return groups


@click.command(cls=TrainCommand)
@with_version
@click.option(
    "--verify-replay",
    type=click.Path(path_type=Path),
    metavar="RUN",
    help="Instead take the first 100 steps of a run again, from its config.json, and compare the metrics with those it "
    "recorded; --shards says where its data are now.",
)
@click.pass_context
def main(context: click.Context, /, **_: Any) -> int:
    """Train a Q-function from shards: `grasp-train --algo mc --shards data/regular-10k`.

    The same command goes on where an earlier one was stopped or killed.

    Several processes train one network with `torchrun --no-python --nproc-per-node 2 grasp-train ...`, each on its part
    of every batch: --batch-size is that of all together. The first alone writes the run folder, which all must see.
    """
    given = given_options(context)
    verified = given.pop("verify_replay", None)
    if verified is not None:
        return _verify_replay(verified, given)
    preset = given.pop("preset", "default")
    settings = complete(given, preset)
    with joined() as ranks:
        if ranks.first:
            click.echo(f"{settings.algo}: {settings.run_folder}", err=True)
        run = train(settings, show_progress=ranks.first, ranks=ranks)
    if ranks.first:
        click.echo(run.summary())
    return 0


def _verify_replay(folder: Path, given: dict[str, Any]) -> int:
    # Imported late: training does not need it.
    from graspq.train.replay import replay

    others = [flag(name) for name in given if name not in OF_REPLAY]
    if others:
        raise UserError(f"--verify-replay: takes the settings of {folder} alone; leave out {others[0]}")
    found = replay(folder, **given, show_progress=True)
    click.echo(f"{folder}: {found.line()}")
    return int(not found.holds)
