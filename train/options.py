"""The options of training on a command line: the common ones, then those of the estimator and of the networks."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import click

from graspq.common.options import Command, Settings, parameters, shown_value
from graspq.train.estimator import Estimator
from graspq.train.estimators import ESTIMATORS, estimator_named
from graspq.train.networks import network_named
from graspq.train.recipe import Recipe
from graspq.train.settings import TrainSettings, refuse_taken_names, unknown_option

# Common options that stand before `--preset`: what is trained, on what, where to.
FIRST = ("algo", "shards", "out", "seed")
PRESET = click.Option(
    ["--preset"],
    type=click.Choice(["default", "paper"]),
    default="default",
    show_default=True,
    help="What decides the options that are not given: our defaults, or the paper's released code.",
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
        estimator = estimator_named(algo) if algo is not None else None
        found = common_parameters(estimator)
        common = [*self.params, *found[: len(FIRST)], PRESET, *found[len(FIRST) :], self.get_help_option(ctx)]
        groups = [("Options", [one for one in common if one is not None])]
        if algo is not None and estimator is not None:
            refuse_taken_names(algo, network)
            groups += [(f"Options of --algo {algo}", own_parameters(estimator))]
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
    for word, following in zip(words, [*words, None][1:], strict=True):
        name, equals, value = word.partition("=")
        if name == option:
            found = value if equals else following
    return found


def _chosen(words: Sequence[str]) -> tuple[str | None, str]:
    """Return the values of `--algo` and `--network` in a command line, as they decide which options there are."""
    algo, network, preset = (value_of(option, words) for option in ("--algo", "--network", "--preset"))
    row = estimator_named(algo) if algo is not None else Estimator
    return algo, network or (row.paper_recipe if preset == "paper" else row.recipe).network


def common_parameters(estimator: Estimator[Any] | None = None) -> list[click.Parameter]:
    """Return the common options of training for a command line; the help shows what either preset gives.

    Args:
        estimator: whose values they are, where it is known.
    """
    row = estimator if estimator is not None else Estimator
    shown = _shown(row.recipe, row.paper_recipe)
    first = (*FIRST, *(field.name for field in dataclasses.fields(Recipe)))
    order = {name: index for index, name in enumerate(first)}
    found = parameters(TrainSettings, shown)
    return sorted(found, key=lambda one: order.get(one.name or "", len(order)))


def own_parameters(estimator: Estimator[Any]) -> list[click.Parameter]:
    """Return the options of an estimator for a command line."""
    return parameters(estimator.settings, _shown(estimator.settings(), estimator.paper))


def network_parameters(network: str) -> list[click.Parameter]:
    """Return the options of networks for a command line."""
    kind = network_named(network).settings
    return parameters(kind, _shown(kind(), kind()))


def _shown(default: Settings, paper: Settings) -> dict[str, str]:
    """Return what the help says of the default of each option."""
    texts = {}
    for field in dataclasses.fields(default):
        ours, theirs = (shown_value(field, getattr(settings, field.name)) for settings in (default, paper))
        texts[field.name] = f"default: {ours}" if ours == theirs else f"default: {ours}; paper: {theirs}"
    return texts
