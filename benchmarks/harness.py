"""What the benchmarks share: rivals take turns, ratios are taken within a turn, and results have one form.

A machine that others share slows all rivals of a turn alike; the median of the turns' ratios hardly moves.
"""

import contextlib
import datetime
import functools
import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import click

from graspq.common.errors import UserError
from graspq.common.options import Command, Settings, options_from, setting
from graspq.common.provenance import code_revision, versions
from graspq.common.text import markdown
from graspq.engine import EngineSettings, Place, run

PACKAGES = ("torch", "pybullet", "pybullet-arm64", "numpy", "pyarrow", "datasets", "d3rlpy")
TOLERANCE = 1e-4  # of a rival's Q to ours
COLUMNS = ("in one run", "measured", "bar", "aim", "met")
Row = dict[str, Any]
S = TypeVar("S", bound=Settings)
T = TypeVar("T")


@dataclass(frozen=True)
class TurnsSettings(Settings):
    """What benchmarks take whose rivals take turns."""

    turns: int = setting(5, help="Turns that are measured.", minimum=1)


@dataclass(frozen=True)
class DataSettings(TurnsSettings):
    """What benchmarks of loading and training take."""

    shards: tuple[str, ...] = setting(("data/regular-10k",), help="Dataset folders, shard files or globs.")


@dataclass(frozen=True)
class Ratio:
    """A line of the published table: what must reach its bar, or stay at or below it where it `is_share`.

    One that says "…" first stands beside the line above. The value is None where the rival is not installed; a text
    such as `at least 20` counts by its number.
    """

    says: str
    value: float | str | None
    bar: float | None = None
    aim: float | None = None
    is_share: bool = False

    def row(self) -> list[str]:
        """Return the cells of the table, as in `COLUMNS`."""

        def shown(value: float | str | None) -> str:
            if value is None or isinstance(value, str):
                return value or ""
            return f"{value:.1%}" if self.is_share else f"{value:.3g}"

        if self.value is None:
            return [self.says, "not measured", "", "", ""]
        if self.bar is None:
            return [self.says, shown(self.value), "", shown(self.aim), ""]
        number = float(str(self.value).rpartition(" ")[2])
        met = number <= self.bar if self.is_share else number >= self.bar
        bar = f"{'≤' if self.is_share else '≥'} {shown(self.bar)}"
        return [self.says, shown(self.value), bar, shown(self.aim), "yes" if met else "**no**"]


@dataclass(frozen=True)
class Result:
    """What a benchmark found: lines of the published table, title -> rows of equal keys, and other facts."""

    ratios: Sequence[Ratio]
    tables: Mapping[str, Sequence[Row]]
    facts: Row = field(default_factory=dict)

    def to_json(self, settings: Settings) -> Row:
        """Return it as plain JSON values, with the settings, the day and the code of the measurement."""
        day = datetime.datetime.now(datetime.UTC).date().isoformat()
        measured = {"on": day, "code_revision": code_revision(), "versions": versions(*PACKAGES)}
        found = {"ratios": [asdict(ratio) for ratio in self.ratios], "tables": self.tables, **self.facts}
        return {**found, "settings": settings.to_json(), "measured": measured}


def command(kind: type[S], measure: Callable[[S], Result]) -> click.Command:
    """Return a benchmark's command, which prints and returns what it found; the module's head is its help."""

    @click.command(cls=Command, help=str(sys.modules[measure.__module__].__doc__).partition("\n\n")[0])
    @options_from(kind)
    def main(settings: S) -> Row:
        result = measure(settings)
        for title, rows in result.tables.items():
            click.echo(f"{title}\n{table(rows)}")
        click.echo(markdown(COLUMNS, [ratio.row() for ratio in result.ratios]))
        return result.to_json(settings)

    return main


def table(rows: Sequence[Row]) -> str:
    """Return rows of equal keys as a Markdown table: three digits of a number, nothing for None."""

    def shown(value: Any) -> str:
        return f"{value:.3g}" if isinstance(value, float) else "" if value is None else str(value)

    return markdown(list(rows[0]), [[shown(value) for value in row.values()] for row in rows])


def take_turns(rivals: Mapping[str, Callable[[int], T]], turns: int, warm_up: bool = True) -> dict[str, list[T]]:
    """Return what every rival gives in every turn; it is handed the turn's number. Every other turn is backwards.

    `warm_up` takes one turn more first, which is not counted.
    """
    found: dict[str, list[T]] = {name: [] for name in rivals}
    for turn in range(-1 if warm_up else 0, turns):
        for name, rival in list(rivals.items())[:: -1 if turn % 2 else 1]:
            result = rival(turn)
            if turn >= 0:
                found[name].append(result)
    return found


def timed(do: Callable[[], Any], count: int = 1) -> Callable[[int], float]:
    """Return a rival that does `count` units of work in a turn, and gives the seconds of one."""

    def seconds(turn: int) -> float:
        start = time.perf_counter()
        do()
        return (time.perf_counter() - start) / count

    return seconds


def median_ratio(over: Sequence[float], under: Sequence[float]) -> float:
    """Return the median over turns of over / under."""
    return statistics.median(a / b for a, b in zip(over, under, strict=True))


def compared(what: str, unit: str, seconds: Mapping[str, Sequence[float]], against: str) -> list[Row]:
    """Return a row for each rival, headed `what`, with how many times as fast as the rival `against` it is.

    `seconds` are those of a unit, such as a `sample`, of every rival in every turn.
    """
    return [
        {
            what: name,
            "ms each": 1e3 * statistics.median(values),
            f"{unit}s a second": 1 / statistics.median(values),
            f"times {against}": median_ratio(seconds[against], values),
        }
        for name, values in seconds.items()
    ]


def check_equal(expected: Any, others: Mapping[str, Any]) -> None:
    """Refuse a rival whose tensor is another than ours (`UserError`)."""
    for name, found in others.items():
        difference = float((found - expected).abs().max())
        if not difference <= TOLERANCE:
            raise UserError(f"{name}: differs from ours by {difference:.2g}, expected at most {TOLERANCE}")


class Calls:
    """Work for the engine: its units are calls."""

    def folders(self) -> list[Path]:
        """Return none: the calls find what they need."""
        return []

    @contextlib.contextmanager
    def open(self, place: Place) -> Iterator[Callable[["functools.partial[Any]"], Any]]:
        """Yield what makes a call."""
        yield lambda call: call()


def apart(*calls: "functools.partial[T]") -> list[T]:
    """Return what calls return, in any order; all are made at once, each in a process of its own."""
    engine = EngineSettings(workers=len(calls))
    done = run(Calls(), calls, engine, name=lambda call: call.func.__qualname__, units_per_worker=1)
    return [result for _, result in done]


def alone(function: Callable[..., T], *arguments: Any) -> T:
    """Return what a function of a module returns when it is called in a process of its own."""
    return apart(functools.partial(function, *arguments))[0]


def resident_bytes() -> int:
    """Return the resident memory of this process; `UserError` where it is not Linux."""
    statm = Path("/proc/self/statm")
    if not statm.is_file():
        raise UserError(f"{statm} is not there: memory is measured on Linux alone")
    return int(statm.read_text().split()[1]) * resource.getpagesize()
