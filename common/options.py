"""Command-line options generated from the frozen dataclass that holds a command's settings.

The dataclass is the single source of names, types, defaults, ranges and help; `config.json` is the same dataclass as
JSON. Whatever is wrong with the user's input becomes one line on standard error and exit status 2.
"""

import dataclasses
import functools
import math
import re
import sys
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import click

import graspq
from graspq.common.errors import UserError, failure_of_machine
from graspq.common.streams import (
    ended_in_order,
    give_up_streams,
    interrupts_without_traceback,
    next_interrupt_ends_at_once,
    readers_are_gone,
    require_names_of_text,
    was_interrupted,
    whole_streams,
)

S = TypeVar("S", bound="Settings")
INTERRUPTED = 130
LONGEST = 2000  # letters of a message: what it quotes may be a file
MOST = 10**9  # of anything that is counted; what is made for each fits in memory

# Here, because the modules of commands import this one before what takes seconds.
if Path(sys.argv[0]).name.startswith("grasp-"):
    interrupts_without_traceback()


def setting(
    default: Any = dataclasses.MISSING,
    *,
    help: str,
    minimum: float | None = None,
    maximum: float | None = None,
    positional: bool = False,
    parse: Callable[[str], Any] | None = None,
    metavar: str | None = None,
    source: str | None = None,
    none: str | None = None,
) -> Any:
    """Return a dataclass field that is also a command-line option.

    Args:
        default: value when the option is not given; without one the option is required.
        help: one sentence with unit and range.
        minimum: least allowed value (inclusive).
        maximum: greatest allowed value (inclusive).
        positional: make it an argument (`RUN...`) rather than an option.
        parse: turns the text of the command line into the value; raises `ValueError` saying what was expected.
        metavar: placeholder in the help text.
        source: where the value comes from, such as a section of the paper; the help ends with it.
        none: the word that stands for None on the command line, where None is a value like any other.
    """
    metadata = {
        "help": f"{help} Source: {source}." if source is not None else help,
        "minimum": minimum,
        "maximum": maximum,
        "positional": positional,
        "parse": parse,
        "metavar": metavar,
        "none": none,
    }
    return dataclasses.field(default=default, metadata=metadata)


@dataclasses.dataclass(frozen=True)
class Settings:
    """Base of every command's settings: validates ranges and choices, reads and writes JSON."""

    def __post_init__(self) -> None:
        """Check ranges and choices.

        Raises:
            UserError: a value is outside its range, not finite, or not one of its choices.
        """
        hints = typing.get_type_hints(type(self))
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if value is None:
                continue
            choices = typing.get_args(hints[field.name]) if _is_literal(hints[field.name]) else ()
            if choices and value not in choices:
                raise UserError(f"{flag(field.name)}: {value!r} is unknown; choose from {', '.join(map(str, choices))}")
            for one in value if isinstance(value, tuple) else (value,):
                _check_range(field, one)

    def to_json(self) -> dict[str, Any]:
        """Return the settings as plain JSON values."""
        return {field.name: _plain(getattr(self, field.name)) for field in dataclasses.fields(self)}

    @classmethod
    def from_json(cls: type[S], values: dict[str, Any]) -> S:
        """Return the settings that `to_json` wrote; unknown names are refused, missing ones take their defaults.

        Raises:
            UserError: a name is unknown, or a value is of another type or out of range.
        """
        if not isinstance(values, dict):
            raise UserError(f"settings {values!r}: expected names and values")
        hints = typing.get_type_hints(cls)
        known = {field.name for field in dataclasses.fields(cls)}
        unknown = sorted(set(values) - known)
        if unknown:
            raise UserError(f"unknown setting {unknown[0]!r}; expected some of {', '.join(sorted(known))}")
        for name, value in values.items():
            if not _fits(hints[name], value):
                raise UserError(f"setting {name}: {value!r} is no value of it")
        lacking = [
            field.name
            for field in dataclasses.fields(cls)
            if field.name not in values and field.default is field.default_factory is dataclasses.MISSING
        ]
        if lacking:
            raise UserError(f"setting {lacking[0]} is missing")
        return cls(**{name: _restored(hints[name], value) for name, value in values.items()})


def _check_range(field: Any, value: Any) -> None:
    minimum, maximum = field.metadata.get("minimum"), field.metadata.get("maximum")
    if isinstance(value, bool) or not isinstance(value, int | float):
        return
    if isinstance(value, float) and not math.isfinite(value):
        raise UserError(f"{flag(field.name)}: expected a finite number, got {value}")
    too_low = minimum is not None and not value >= minimum
    too_high = maximum is not None and not value <= maximum
    if not too_low and not too_high:
        return
    limits = (("at least", minimum), ("at most", maximum))
    bounds = [f"{words} {limit:g}" for words, limit in limits if limit is not None]
    raise UserError(f"{flag(field.name)}: expected a number of {' and '.join(bounds)}, got {value}")


def _fits(hint: Any, value: Any) -> bool:
    """Return whether a value of JSON, or one that `_restored` gave, can be one of a setting of this type."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return any(_fits(part, value) for part in typing.get_args(hint))
    if hint in (type(None), None):
        return value is None
    if typing.get_origin(hint) is tuple:
        inner = typing.get_args(hint)[0]
        return isinstance(value, list | tuple) and all(_fits(inner, item) for item in value)
    known: dict[Any, tuple[type, ...]] = {
        int: (int,), float: (int, float), str: (str,), bool: (bool,), Path: (str, Path),
    }  # fmt: skip
    kinds = known.get(hint)
    return kinds is None or (isinstance(value, kinds) and (hint is bool or not isinstance(value, bool)))


def _plain(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value


def _restored(hint: Any, value: Any) -> Any:
    if isinstance(value, list):
        inner = typing.get_args(hint)
        return tuple(_restored(inner[0] if inner else str, item) for item in value)
    if value is not None and (hint is Path or Path in typing.get_args(hint)):
        return Path(value)
    return value


def flag(name: str) -> str:
    """Return the option of a settings field: `batch_size` is `--batch-size`."""
    return "--" + name.replace("_", "-")


def parse_count(text: str) -> int:
    """Return a count written plainly or with k or M: `2500`, `10k`, `1M`.

    Raises:
        ValueError: the text is no whole number of at least 1, or it is above a thousand million.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([kKmM]?)", text.strip())
    factor = {"": 1, "k": 1_000, "m": 1_000_000}
    value = float(match[1]) * factor[match[2].lower()] if match else 0.0
    if not 1 <= value <= MOST or value != int(value):
        raise ValueError("expected a whole number of at least 1, such as 2500, 10k or 1M, and at most 1000M")
    return int(value)


class _Parsed(click.ParamType):  # type: ignore[type-arg]
    """A click type around a `parse` function."""

    def __init__(self, parse: Callable[[str], Any], name: str) -> None:
        self.parse, self.name = parse, name

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        if not isinstance(value, str):
            return value
        try:
            return self.parse(value)
        except UserError:
            raise
        except ValueError as error:
            self.fail(f"{value!r}: {error}", param, ctx)


class _OrNone(click.ParamType):  # type: ignore[type-arg]
    """A click type with a word that stands for None."""

    def __init__(self, kind: Any, word: str) -> None:
        self.kind, self.word, self.name = kind, word, kind.name

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        return None if value == self.word else self.kind.convert(value, param, ctx)


def shown_value(field: "dataclasses.Field[Any]", value: Any) -> str:
    """Return a setting's value as the command line takes it, for help texts."""
    if value is None:
        return field.metadata.get("none") or "none"
    if isinstance(value, bool):
        return flag(field.name) if value else f"--no-{flag(field.name)[2:]}"
    return f"{value:g}" if isinstance(value, float) else str(value)


def options_from(settings_type: type[Settings]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that gives a click command the options of `settings_type`.

    The decorated function receives one argument, the validated settings.
    """

    def decorate(function: Callable[[Any], Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def command(**values: Any) -> Any:
            return function(settings_type(**values))

        command.__click_params__ = list(reversed(parameters(settings_type)))  # type: ignore[attr-defined]
        return command

    return decorate


def parameters(settings_type: type[Settings], defaults: Mapping[str, str] | None = None) -> list[click.Parameter]:
    """Return the options of `settings_type`, its own before those it inherits; a field without help is none.

    Args:
        settings_type: the settings.
        defaults: what the help says of the defaults of some fields, by name. These options have no default for click:
            whoever reads them must ask `given_options` which were given.
    """
    hints = typing.get_type_hints(settings_type)
    shown, inherited = defaults or {}, lambda field: field.name not in settings_type.__annotations__
    return [
        _parameter(field, hints[field.name], shown.get(field.name))
        for field in sorted(dataclasses.fields(settings_type), key=inherited)
        if field.metadata.get("help") is not None
    ]


def given_options(context: click.Context) -> dict[str, Any]:
    """Return the options that the command line gave, by the names of their fields: "not given" is no value."""
    spoken = click.core.ParameterSource.COMMANDLINE
    return {name: value for name, value in context.params.items() if context.get_parameter_source(name) is spoken}


def _is_literal(hint: Any) -> bool:
    return typing.get_origin(hint) is typing.Literal


def _parameter(field: Any, hint: Any, shown: str | None) -> click.Parameter:
    several = typing.get_origin(hint) is tuple
    inner = typing.get_args(hint)[0] if several else _without_none(hint)
    parse, metavar = field.metadata["parse"], field.metadata["metavar"]
    required = field.default is dataclasses.MISSING
    kind = _Parsed(parse, field.name) if parse is not None else _click_type(inner)
    if field.metadata["none"] is not None:
        kind, metavar = _OrNone(kind, field.metadata["none"]), f"{kind.name.upper()}|{field.metadata['none']}"
    if field.metadata["positional"]:
        return click.Argument([field.name], type=kind, nargs=-1 if several else 1, required=required, metavar=metavar)
    text = field.metadata["help"] if shown is None else f"{field.metadata['help']} [{shown}]"
    arguments: dict[str, Any] = {"help": text, "required": required and shown is None, "multiple": several}
    if several:
        arguments["default"] = ()
    if shown is None and not required and field.default is not None and field.default != ():
        arguments |= {"default": field.default, "show_default": True}
    if inner is bool:
        # Said outright: click makes of a switch without a default, and not given, False.
        arguments.setdefault("default", None)
        return click.Option([f"{flag(field.name)}/--no-{flag(field.name)[2:]}", field.name], **arguments)
    return click.Option([flag(field.name), field.name], type=kind, metavar=metavar, **arguments)


def _without_none(hint: Any) -> Any:
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        return next(part for part in typing.get_args(hint) if part is not type(None))
    return hint


def _click_type(hint: Any) -> Any:
    if _is_literal(hint):
        return click.Choice([str(choice) for choice in typing.get_args(hint)])
    return {int: click.INT, float: click.FLOAT, str: click.STRING, bool: click.BOOL}.get(
        hint, click.Path(path_type=Path) if hint is Path else click.STRING
    )


def _spread_repeated(parameters: Sequence[click.Parameter], args: list[str]) -> list[str]:
    """Let an option that may be repeated take several words, as a shell's glob gives: `--shards a b c`."""
    if any(isinstance(parameter, click.Argument) for parameter in parameters):
        return args
    repeated = {name for parameter in parameters if getattr(parameter, "multiple", False) for name in parameter.opts}
    spread: list[str] = []
    current: str | None = None
    for word in args:
        if word.startswith("-"):
            current = word if word in repeated else None
            spread.append(word)
        elif current is not None and spread[-1] != current:
            spread += [current, word]
        else:
            spread.append(word)
    return spread


class _OneLineErrors:
    """Turns every mistake of the user into one line and exit status 2."""

    def main(self, args: Sequence[str] | None = None, prog_name: str | None = None, **extra: Any) -> Any:
        """Run the command and exit; see the class."""
        extra.pop("standalone_mode", None)
        whole_streams()
        try:
            require_names_of_text(sys.argv[1:] if args is None else args)
            with ended_in_order():
                result = super().main(args=args, prog_name=prog_name, standalone_mode=False, **extra)  # type: ignore[misc]
        except click.exceptions.Abort:
            next_interrupt_ends_at_once()
            click.echo("interrupted", err=True)
            sys.exit(INTERRUPTED)
        except click.UsageError as error:
            where = error.ctx.command_path if error.ctx is not None else (prog_name or "graspq")
            click.echo(f"{where}: {_one_line(error.format_message())} (see {where} --help)", err=True)
            sys.exit(2)
        except click.ClickException as error:
            click.echo(f"error: {_one_line(error.format_message())}", err=True)
            sys.exit(error.exit_code)
        except Exception as error:
            failure = failure_of_machine(error)
            if failure is None and was_interrupted():
                click.echo("interrupted", err=True)
                sys.exit(INTERRUPTED)
            if failure is None:
                raise
            click.echo(f"error: {_one_line(failure.message)}", err=True)
            sys.exit(failure.exit_code)
        sys.exit(result if isinstance(result, int) else 0)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; where nobody reads what it says any more, it ends without a word, as others do."""
        try:
            return super().invoke(ctx)  # type: ignore[misc]
        except BrokenPipeError as error:
            if not readers_are_gone():
                # click would take it for that.
                raise RuntimeError("a pipe to another process is broken") from error
            give_up_streams()
            sys.exit(1)


def _one_line(message: str) -> str:
    line = " ".join(message.split())
    return line if len(line) <= LONGEST else f"{line[: LONGEST // 2]} ... {line[-LONGEST // 2 :]}"


class Command(_OneLineErrors, click.Command):  # type: ignore[misc]
    """A click command with one-line errors whose repeatable options take several words."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse after spreading repeated options; see `_spread_repeated`."""
        return super().parse_args(ctx, _spread_repeated(self.get_params(ctx), args))


class Group(_OneLineErrors, click.Group):  # type: ignore[misc]
    """A click group with one-line errors."""

    command_class = Command


def with_version(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--version`, the version of graspq."""
    return click.version_option(graspq.__version__, prog_name="graspq")(command)
