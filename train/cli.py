"""`grasp-train`: trains one estimator purely off-policy from shards.

The way on: `settings` -> `loop` -> `estimators/<row>` -> `targets` and `selection`.
"""

from collections.abc import Sequence
from typing import Any

import click

from graspq.common.options import Command, given_options, with_version
from graspq.train.estimators import ESTIMATORS, estimator_named
from graspq.train.loop import train
from graspq.train.parallel import joined
from graspq.train.recipe import PAPER, Recipe
from graspq.train.run import Run
from graspq.train.settings import (
    common_parameters,
    complete,
    network_parameters,
    own_parameters,
    unknown_option,
)

# Common options that stand before `--preset`: what is trained, on what, where to.
FIRST = 4
PRESET = click.Option(
    ["--preset"],
    type=click.Choice(["default", "paper"]),
    default="default",
    show_default=True,
    help="What decides the options that are not given: our defaults, or the paper's text and its released code.",
)


class TrainingCommand(Command):
    """A command that takes the common options of training, and then those of the `--algo` and `--network` it is given.

    Its own parameters come first.
    """

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse; the options depend on the values of `--algo`, `--preset` and `--network`."""
        ctx.meta["words"] = list(args)
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            algo, network = _chosen(args)
            if algo is None:
                raise
            raise click.UsageError(unknown_option(error.option_name, algo, network), ctx) from None

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Return all parameters, in the groups of the help."""
        return [parameter for _, group in self.groups(ctx) for parameter in group]

    def groups(self, ctx: click.Context) -> list[tuple[str, list[click.Parameter]]]:
        """Return the parameters in groups: name of the group, its parameters."""
        algo, network = _chosen(ctx.meta.get("words", []))
        row = estimator_named(algo) if algo is not None else None
        found = common_parameters(row)
        common = [*self.params, *found[:FIRST], PRESET, *found[FIRST:], self.get_help_option(ctx)]
        groups = [("Options", [one for one in common if one is not None])]
        if row is not None:
            groups += [(f"Options of --algo {algo}", own_parameters(row))]
            groups += [(f"Options of --network {network}", network_parameters(network))]
        return groups

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the groups of options, one after the other."""
        for name, group in self.groups(ctx):
            records = [record for one in group if (record := one.get_help_record(ctx)) is not None]
            if records:
                with formatter.section(name):
                    formatter.write_dl(records)
        if _chosen(ctx.meta.get("words", []))[0] is None:
            with formatter.section("Estimators, each with options of its own: --algo NAME --help"):
                formatter.write_dl([(name, f"{row.summary}.") for name, row in ESTIMATORS.items()])


def value_of(option: str, words: Sequence[str]) -> str | None:
    """Return the value that a command line's words give to an option, the last where it stands twice."""
    found = None
    for word, following in zip(words, [*words[1:], None], strict=True):
        name, equals, value = word.partition("=")
        if name == option:
            found = value if equals else following
    return found


def _chosen(words: Sequence[str]) -> tuple[str | None, str]:
    """Return the values of `--algo` and `--network` in a command line, as they decide which options there are."""
    algo, recipe = value_of("--algo", words), Recipe()
    if value_of("--preset", words) == "paper":
        recipe = estimator_named(algo).paper_recipe if algo is not None else PAPER
    return algo, value_of("--network", words) or recipe.network


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
