"""`grasp-train`: trains one estimator purely off-policy from shards.

The way on: `settings` -> `loop` -> `estimators/<row>` -> `targets` and `selection`.
"""

from typing import Any

import click

from graspq.common.options import given_options, with_version
from graspq.train.loop import train
from graspq.train.options import TrainingCommand
from graspq.train.parallel import joined
from graspq.train.run import Run
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
    settings = complete(given, given.pop("preset", "default"))
    with joined() as ranks:
        if ranks.first:
            click.echo(f"{settings.algo}: {settings.run_folder}", err=True)
        run = train(settings, show_progress=ranks.first, ranks=ranks)
    if ranks.first:
        click.echo(_summary(run))


def _summary(run: Run) -> str:
    """Return one line on how the run ended."""
    rows: list[dict[str, Any]] = run.metrics()
    parts = [str(run.folder)]
    losses = [row for row in rows if "loss" in row]
    if losses:
        parts.append(f"step {losses[-1]['step']}, loss {losses[-1]['loss']:.4f}")
        parts.append(f"{losses[-1]['samples_per_second']:.0f} samples/s")
    validations = [row["validation"] for row in rows if "validation" in row]
    if validations:
        parts.append(f"held-back loss {validations[-1]['loss']:.4f}")
        auc = validations[-1]["roc_auc_last_step"]
        parts += [f"ROC AUC of last steps {auc:.3f}"] if auc is not None else []
    return "; ".join(parts)
