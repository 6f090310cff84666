import dataclasses
from pathlib import Path
from typing import Literal

import click
import pytest

from graspq.common.errors import UserError
from graspq.common.options import (
    Command,
    Group,
    Settings,
    given_options,
    options_from,
    parameters,
    parse_count,
    setting,
    shown_value,
    with_version,
)


@dataclasses.dataclass(frozen=True)
class Example(Settings):
    algo: Literal["mc", "dql"] = setting("mc", help="estimator")
    rate: float = setting(0.1, help="rate", minimum=0.0, maximum=1.0)
    size: int = setting(10, help="count", parse=parse_count, minimum=1)
    shards: tuple[str, ...] = setting((), help="folders")
    out: Path | None = setting(None, help="folder")
    mirror: bool = setting(True, help="mirror")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"rate": "0.5"}, "setting rate"),
        ({"rate": True}, "setting rate"),
        ({"size": 1.5}, "setting size"),
        ({"shards": "data"}, "setting shards"),
        ({"shards": [1]}, "setting shards"),
        ({"out": 3}, "setting out"),
        ({"mirror": 1}, "setting mirror"),
        ({"rate": float("nan")}, "finite"),
        ([], "expected names and values"),
    ],
)
def test_values_of_a_file_must_be_of_their_types(values, message):
    with pytest.raises(UserError, match=message):
        Example.from_json(values)


def run(*arguments):
    """Run a command made from `Example`; return (exit status, settings or None)."""
    seen = []

    @click.command(cls=Command)
    @with_version
    @options_from(Example)
    def main(settings):
        seen.append(settings)

    with pytest.raises(SystemExit) as stopped:
        main.main(list(arguments), prog_name="example")
    return stopped.value.code, seen[0] if seen else None


def test_options_are_the_fields_with_their_types_and_defaults():
    assert run() == (0, Example())
    code, settings = run("--algo", "dql", "--rate", "0.5", "--size", "2k", "--out", "x", "--no-mirror")
    assert code == 0
    assert settings == Example("dql", 0.5, 2000, (), Path("x"), False)


def test_a_repeatable_option_takes_several_words():
    assert run("--shards", "a", "b", "--algo", "dql", "--shards", "c")[1].shards == ("a", "b", "c")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--algo", "sarsa"), "'sarsa' is not one of 'mc', 'dql'"),
        (("--rate", "2"), "--rate: expected a number of at least 0 and at most 1, got 2.0"),
        (("--rate", "fast"), "'fast' is not a valid float"),
        (("--size", "0"), "expected a whole number of at least 1"),
        (("--sise", "3"), "No such option"),
    ],
)
def test_a_mistake_is_one_line_and_exit_status_two(capsys, arguments, message):
    code, settings = run(*arguments)
    error = capsys.readouterr().err.strip()
    assert (code, settings) == (2, None)
    assert message in error
    assert "\n" not in error


def test_a_defect_of_ours_keeps_its_traceback():
    @click.command(cls=Command)
    def main():
        raise KeyError("ours")

    with pytest.raises(KeyError, match="ours"):
        main.main([], prog_name="example")


def test_subcommands_have_one_line_errors_too(capsys):
    @click.group(cls=Group)
    def main():
        pass

    with pytest.raises(SystemExit) as stopped:
        main.main(["unknown"], prog_name="example")
    assert stopped.value.code == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_settings_survive_json_and_unknown_names_are_refused():
    settings = Example(shards=("a", "b"), out=Path("x"), rate=0.25)
    assert Example.from_json(settings.to_json()) == settings
    with pytest.raises(UserError, match="unknown setting 'speed'"):
        Example.from_json({"speed": 1})


@pytest.mark.parametrize(("text", "count"), [("2500", 2500), ("10k", 10_000), ("1M", 1_000_000), ("1.5k", 1500)])
def test_counts_are_written_with_k_and_m(text, count):
    assert parse_count(text) == count


@pytest.mark.parametrize("text", ["0", "-3", "ten", "", "1.0001k5", "0.5", "1e3"])
def test_what_is_no_count_is_refused(text):
    with pytest.raises(ValueError, match="whole number of at least 1"):
        parse_count(text)


@dataclasses.dataclass(frozen=True)
class WithNone(Settings):
    """Settings in which None is a value like any other, whose defaults somebody else decides."""

    steps: int = setting(help="count", parse=parse_count)
    penalty: float | None = setting(3.0, help="weight", minimum=0, none="tuned", source="the text, section 3")
    mirror: bool = setting(True, help="mirror")
    unsaid: int = 4


SHOWN = {"penalty": "default: 3", "mirror": "default: --mirror", "steps": "default: 5"}


def given(*words):
    """Return which options of `WithNone` the command line gave."""
    command = Command("example", params=parameters(WithNone, SHOWN))
    with command.make_context("example", list(words)) as context:
        return given_options(context)


def test_only_what_was_said_is_given_and_none_that_was_said_is_a_value():
    assert given() == {}
    assert given("--penalty", "tuned") == {"penalty": None}
    assert given("--penalty", "3") == {"penalty": 3.0}
    assert given("--no-mirror", "--steps", "2k") == {"mirror": False, "steps": 2000}
    assert given("--mirror") == {"mirror": True}


def test_another_word_than_the_one_for_none_is_refused():
    with pytest.raises(click.BadParameter, match="'none' is not a valid float"):
        given("--penalty", "none")


def test_the_help_has_the_word_for_none_the_source_and_what_decides_the_default():
    command = Command("example", params=parameters(WithNone, SHOWN))
    with command.make_context("example", []) as context:
        shown = " ".join(command.get_help(context).split())
    assert "--penalty FLOAT|tuned weight Source: the text, section 3. [default: 3]" in shown
    assert "--mirror / --no-mirror mirror [default: --mirror]" in shown
    assert "unsaid" not in shown, "a field without help is no option"


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [("penalty", None, "tuned"), ("penalty", 0.25, "0.25"), ("mirror", False, "--no-mirror"), ("steps", 7, "7")],
)
def test_a_value_is_shown_as_the_command_line_takes_it(name, value, text):
    fields = {field.name: field for field in dataclasses.fields(WithNone)}
    assert shown_value(fields[name], value) == text
