"""The ratios that are published: where each stands in what a benchmark wrote, and the bar that it must reach."""

import dataclasses
from collections.abc import Callable
from typing import Any

from graspq.common.errors import UserError

Found = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Ratio:
    """A line of the table.

    Attributes:
        part: where it is measured.
        says: what it is.
        value: finds it in what the part wrote.
        bar: what it must reach, in words.
        meets: whether a number does.
    """

    part: str
    says: str
    value: Callable[[Found], Any]
    bar: str
    meets: Callable[[float], bool]


def row_where(rows: list[Found], **wanted: Any) -> Found:
    """Return the first row with these values.

    Raises:
        UserError: there is none.
    """
    for row in rows:
        if all(row.get(name) == value for name, value in wanted.items()):
            return row
    raise UserError(f"no row with {wanted} in what a benchmark wrote; measure it --again")


def at_least(bar: float) -> tuple[str, Callable[[float], bool]]:
    """Return a bar in words and as a test."""
    return f"≥ {bar:g}", lambda value: value >= bar


def at_most(bar: float) -> tuple[str, Callable[[float], bool]]:
    """Return a bar in words and as a test; for shares."""
    return f"≤ {bar:.0%}", lambda value: value <= bar


def _loader(name: str) -> Callable[[Found], Any]:
    return lambda found: row_where(found["rows"], loader=name)["times PNG files"]


def _estimator(name: str) -> Callable[[Found], Any]:
    return lambda found: row_where(found["rows"], estimator=name)["times mc"]


def _training(name: str) -> Callable[[Found], Any]:
    return lambda found: row_where(found["rows"], training=f"{name}, graspq")["times its rival"]


def _waiting(name: str) -> Callable[[Found], Any]:
    return lambda found: row_where(found["waiting for data in training"], estimator=name)["share of waiting"]


def _evaluation(way: str) -> Callable[[Found], Any]:
    name = f"one at a time, {way}"
    return lambda found: row_where(found["rows"], evaluation=name)["graspq is faster, times"]


def _decision(name: str) -> Callable[[Found], Any]:
    return lambda found: row_where(found["rows"], batch=1, decision=name)["times of trunk once"]


RATIOS = (
    Ratio(
        "collection",
        "grasps collected a second and core, against the wheel's `KukaDiverseObjectEnv`",
        lambda found: row_where(found["rows"], environment="graspq")["times (grasps)"],
        *at_least(25),
    ),
    Ratio(
        "collection",
        "collection, 2 workers against 1",
        lambda found: row_where(found["Scaling over workers"], workers=2)["times 1 worker"],
        *at_least(1.8),
    ),
    Ratio(
        "loading",
        "shuffled transitions from disk, against PNG + `DataLoader`",
        _loader("graspq, streaming"),
        *at_least(10),
    ),
    Ratio(
        "loading",
        "… with all data in the buffer, first epoch",
        _loader("graspq, all in the buffer, first epoch"),
        *at_least(10),
    ),
    Ratio("loading", "share of a training step spent waiting for data, `mc`", _waiting("mc"), *at_most(0.05)),
    Ratio("loading", "… `dql`", _waiting("dql"), *at_most(0.05)),
    Ratio(
        "loading",
        "growth of a streaming loader's memory, data ten times the buffer",
        lambda found: row_where(found["resident memory of streaming"])["growth"],
        *at_most(0.02),
    ),
    Ratio("training", "training of `mc`, against the same network in plain PyTorch", _training("mc"), *at_least(2)),
    Ratio("training", "… of `dql`", _training("dql"), *at_least(2)),
    Ratio("estimators", "transitions a second of `dql`, against `mc`", _estimator("dql"), *at_least(0.5)),
    Ratio("estimators", "… of `corr-mc`", _estimator("corr-mc"), *at_least(0.4)),
    Ratio(
        "decision",
        "a CEM decision, against 64 tiled copies in each iteration",
        _decision("cem, 64 tiled copies"),
        *at_least(4),
    ),
    Ratio(
        "evaluation",
        "episodes a second, against one at a time with tiled copies",
        _evaluation("64 tiled copies"),
        *at_least(4),
    ),
    Ratio(
        "time_to_quality",
        "seconds of training until ROC AUC 0.75, the paper's settings against ours",
        lambda found: found["the paper's time over ours, median"],
        *at_least(5),
    ),
)


def ratio_rows(found: dict[str, Found], commands: dict[str, str]) -> list[dict[str, Any]]:
    """Return the table's rows for the parts that were measured.

    Args:
        found: what the parts wrote, by name.
        commands: that make them, by name.
    """
    rows = []
    for ratio in RATIOS:
        if ratio.part in found:
            value = ratio.value(found[ratio.part])
            number = float(str(value).rpartition(" ")[2])  # "at least 20" counts as 20
            rows.append(
                {
                    "in one run": ratio.says,
                    "measured": f"{number:.1%}" if "%" in ratio.bar else value,
                    "bar": ratio.bar,
                    "met": "yes" if ratio.meets(number) else "**no**",
                    "command": f"`{commands[ratio.part]}`",
                }
            )
    return rows
