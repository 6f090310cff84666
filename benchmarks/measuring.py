"""What the benchmarks share: rivals take turns, ratios are taken within a turn, and results are written in one form.

A machine that others share slows all rivals of a turn alike; the median of the turns' ratios hardly moves.
"""

import contextlib
import datetime
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import click

from graspq.common.errors import UserError
from graspq.common.files import write_json
from graspq.common.options import Command, Settings, options_from, setting
from graspq.common.provenance import code_revision, versions
from graspq.common.text import markdown
from graspq.engine import EngineSettings, Place, run

PACKAGES = ("torch", "pybullet", "pybullet-arm64", "numpy", "pyarrow", "datasets", "d3rlpy")
TOLERANCE = 1e-4  # of a rival's Q to ours
Row = dict[str, Any]


@dataclass(frozen=True)
class BenchmarkSettings(Settings):
    """What every benchmark's command takes."""

    out: Path | None = setting(None, help="JSON file for the figures.")


@dataclass(frozen=True)
class TurnsSettings(BenchmarkSettings):
    """What benchmarks take whose rivals take turns."""

    turns: int = setting(5, help="Turns that are measured.", minimum=1)


@dataclass(frozen=True)
class TrainingSpeedSettings(TurnsSettings):
    """What the benchmarks of training and loading take."""

    shards: tuple[str, ...] = setting(("data/regular-10k",), help="Dataset folders, shard files or globs.")
    threads: int | None = setting(None, help="CPU threads; torch's own choice if not given.", minimum=1)


B = TypeVar("B", bound=BenchmarkSettings)


class Ratio(NamedTuple):
    """A line of the published table.

    Attributes:
        says: what it is; one that begins with an ellipsis stands beside the line above.
        value: what was measured; a text such as `at least 20` counts by its number.
        bar: what it must reach; None for none.
        aim: what it should reach.
        is_share: whether it is a share that must stay at or below its bar, rather than reach it.
    """

    says: str
    value: float | str | None
    bar: float | None = None
    aim: float | None = None
    is_share: bool = False

    def row(self) -> list[str]:
        """Return the cells of the table: words, measured, bar, aim, met."""

        def shown(value: float | str | None) -> str:
            if value is None or isinstance(value, str):
                return value or ""
            return f"{value:.1%}" if self.is_share else f"{value:.3g}"

        if self.value is None:
            return [self.says, "not measured", "", "", ""]
        number = float(str(self.value).rpartition(" ")[2])
        sign = "≤" if self.is_share else "≥"
        reached = self.bar is not None and (number <= self.bar if self.is_share else number >= self.bar)
        met = "" if self.bar is None else "yes" if reached else "**no**"
        bar = "" if self.bar is None else f"{sign} {shown(self.bar)}"
        return [self.says, shown(self.value), bar, shown(self.aim), met]


@dataclass(frozen=True)
class Result:
    """What a benchmark found.

    Attributes:
        ratios: the lines of the published table.
        tables: title -> rows of equal keys.
        facts: what else belongs to it.
    """

    ratios: Sequence[Ratio]
    tables: Mapping[str, Sequence[Row]]
    facts: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self, settings: BenchmarkSettings) -> dict[str, Any]:
        """Return it as plain JSON values, with the settings, the day and the code of the measurement."""
        day = datetime.datetime.now(datetime.UTC).date().isoformat()
        measured = {"on": day, "code_revision": code_revision(), "versions": versions(*PACKAGES)}
        ratios = [ratio._asdict() for ratio in self.ratios]
        given = {name: value for name, value in settings.to_json().items() if name != "out"}
        return {"ratios": ratios, "tables": dict(self.tables), **self.facts, "settings": given, "measured": measured}

    def publish(self, settings: BenchmarkSettings) -> None:
        """Print it, and write it as JSON where the settings say."""
        for title, rows in self.tables.items():
            print(f"{title}\n{table(rows)}")
        for name, value in self.facts.items():
            print(f"{name}: {shown(value)}")
        print(f"\n{markdown(('in one run', 'measured', 'bar', 'aim', 'met'), [one.row() for one in self.ratios])}")
        if settings.out is not None:
            write_json(settings.out, self.to_json(settings))


def command(kind: type[B], measure: Callable[[B], Result]) -> click.Command:
    """Return a benchmark's command, which measures, prints the result and writes it; the module's head is its help."""
    head = str(sys.modules[measure.__module__].__doc__).partition("\n\n")[0]

    @click.command(cls=Command, help=head)
    @options_from(kind)
    def main(settings: B) -> None:
        measure(settings).publish(settings)

    return main


def table(rows: Sequence[Row]) -> str:
    """Return rows of equal keys as a Markdown table."""
    return markdown(list(rows[0]), [[shown(value) for value in row.values()] for row in rows])


def shown(value: Any) -> str:
    """Return a value for a table: three digits of a number, nothing for None."""
    if value is None:
        return ""
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def take_turns(rivals: Mapping[str, Callable[[], Any]], turns: int) -> dict[str, list[float]]:
    """Return the seconds of every rival in every turn, after one that is not counted; every other turn is backwards."""
    seconds: dict[str, list[float]] = {name: [] for name in rivals}
    for turn in range(turns + 1):
        for name, do in list(rivals.items())[:: 1 if turn % 2 else -1]:
            start = time.perf_counter()
            do()
            if turn > 0:
                seconds[name].append(time.perf_counter() - start)
    return seconds


def median_ratio(over: Sequence[float], under: Sequence[float]) -> float:
    """Return the median over turns of over / under."""
    return statistics.median(a / b for a, b in zip(over, under, strict=True))


def compared(
    what: str, unit: str, seconds: Mapping[str, Sequence[float]], counts: Mapping[str, int], against: str
) -> tuple[list[Row], dict[str, float]]:
    """Return a row for each rival, and how many times as fast as one of them it is.

    Args:
        what: heading of the rivals' names.
        unit: what is counted, such as `samples`.
        seconds: of every rival in every turn.
        counts: units that a rival does in a turn.
        against: name of the rival that all are held against.
    """
    pace = {name: [value / counts[name] for value in values] for name, values in seconds.items()}
    times = {name: median_ratio(pace[against], values) for name, values in pace.items()}
    rows = [
        {what: name, f"{unit} a second": 1 / statistics.median(values), f"times {against}": times[name]}
        for name, values in pace.items()
    ]
    return rows, times


def greatest_difference(expected: Any, others: Mapping[str, Any]) -> float:
    """Return how far any rival's tensor lies from ours, at most.

    Raises:
        UserError: a rival computes something else.
    """
    differences = {name: float((found - expected).abs().max()) for name, found in others.items()}
    for name, difference in differences.items():
        if not difference <= TOLERANCE:
            raise UserError(f"{name}: differs from ours by {difference:.2g}, expected at most {TOLERANCE}")
    return max(differences.values())


class Call(NamedTuple):
    """A function of a module and its arguments."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...] = ()


class Calls:
    """Work for the engine: its units are calls."""

    def folders(self) -> list[Path]:
        """Return none: the calls find what they need."""
        return []

    @contextlib.contextmanager
    def open(self, place: Place) -> Iterator[Callable[[Call], Any]]:
        """Yield what makes a call."""
        yield lambda call: call.function(*call.arguments)


def apart(calls: Iterable[Call], at_once: int = 1) -> Iterator[Any]:
    """Yield what each call returns, each made in a process of its own; so many at once, and then in any order."""
    for _, result in run(Calls(), calls, EngineSettings(workers=at_once), name=_name, units_per_worker=1):
        yield result


def _name(call: Call) -> str:
    return f"{call.function.__module__}.{call.function.__name__}"


def resident_bytes() -> int:
    """Return the resident memory of this process.

    Raises:
        UserError: the system has no /proc.
    """
    status = Path("/proc/self/status")
    if not status.is_file():
        raise UserError(f"{status} is not there: memory is measured on Linux alone")
    line = next(line for line in status.read_text().splitlines() if line.startswith("VmRSS:"))
    return int(line.split()[1]) * 1024
