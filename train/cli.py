"""`grasp-train`: trains one estimator purely off-policy from shards.

Every option comes from `TrainSettings`; the loop is `train/loop.py`.
"""

from typing import Any

import click

from graspq.common.options import Command, Settings, options_from, with_version
from graspq.train.distributed import joined
from graspq.train.loop import train
from graspq.train.run import Run
from graspq.train.settings import TrainOptions, resolve


@click.command(cls=Command)
@with_version
@options_from(TrainOptions)
def main(options: Settings) -> None:
    """Train a Q-function from shards: `grasp-train --algo mc --shards data/regular-10k`.

    The same command goes on where an earlier one was stopped or killed.

    Several processes train one network with `torchrun --no-python --nproc-per-node 2 grasp-train ...`, each on its part
    of every batch: --batch-size is that of all together, and they learn what one learns, up to rounding. With GPUs each
    takes one of its own. The first alone writes the run folder, which all must see; an error of one ends all.
    """
    settings = resolve(options)
    with joined(settings.device) as ranks:
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
