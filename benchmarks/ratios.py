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
        bar: what it must reach, in words; empty for a line that stands beside another.
        aim: what it should reach.
        meets: whether a number reaches the bar.
    """

    part: str
    says: str
    value: Callable[[Found], Any]
    bar: str
    aim: str
    meets: Callable[[float], bool] | None


def row_where(rows: list[Found], **wanted: Any) -> Found:
    """Return the first row with these values.

    Raises:
        UserError: there is none.
    """
    for row in rows:
        if all(row.get(name) == value for name, value in wanted.items()):
            return row
    raise UserError(f"no row with {wanted} in what a benchmark wrote; measure it --again")


def at_least(bar: float, aim: float | None = None) -> tuple[str, str, Callable[[float], bool]]:
    """Return a bar and an aim in words, and the bar as a test."""
    return f"≥ {bar:g}", "" if aim is None else f"{aim:g}", lambda value: value >= bar


def at_most(bar: float, aim: float | None = None) -> tuple[str, str, Callable[[float], bool]]:
    """Return a bar and an aim in words, and the bar as a test; for shares."""
    return f"≤ {bar:.0%}", "" if aim is None else f"{aim:.0%}", lambda value: value <= bar


# Shown without a bar: what a reader needs to judge the line above.
BESIDE: tuple[str, str, Callable[[float], bool] | None] = ("", "", None)


def _loader(name: str) -> Callable[[Found], Any]:
    return lambda found: row_where(found["rows"], loader=name)["times PNG files"]


def _estimator(name: str) -> Callable[[Found], Any]:
    return lambda found: row_where(found["rows"], estimator=name)["times mc"]


def _roofline(name: str) -> Callable[[Found], Any]:
    return lambda found: row_where(found["rows"], training=name)["share of the roof"]


def _training(name: str) -> Callable[[Found], Any]:
    return lambda found: row_where(found["rows"], training=f"{name}, graspq")["times its rival"]


def _waiting(name: str, what: str = "share of waiting") -> Callable[[Found], Any]:
    return lambda found: row_where(found["waiting for data in training"], estimator=name)[what]


def _collected(what: str) -> Callable[[Found], Any]:
    return lambda found: row_where(found["rows"], environment="graspq")[f"times ({what})"]


def _evaluation(way: str) -> Callable[[Found], Any]:
    name = f"one at a time, {way}"
    return lambda found: row_where(found["rows"], evaluation=name)["graspq is faster, times"]


def _decision(name: str) -> Callable[[Found], Any]:
    return lambda found: row_where(found["rows"], batch=1, decision=name)["times of trunk once"]


RATIOS = (
    Ratio(
        "collection",
        "grasps collected a second and core, against the wheel's `KukaDiverseObjectEnv`",
        _collected("grasps"),
        *at_least(25, 50),
    ),
    Ratio("collection", "… a simulated action (a grasp of ours has fewer of them)", _collected("actions"), *BESIDE),
    Ratio("collection", "… a rendered frame", _collected("frames"), *BESIDE),
    Ratio(
        "collection",
        "collection, 2 workers against 1",
        lambda found: row_where(found["Scaling over workers"], workers=2)["times 1 worker"],
        *at_least(1.8, 1.95),
    ),
    Ratio(
        "worker_memory",
        "growth of a worker's memory in its life, MB",
        lambda found: found["growth in a worker's life, MB"],
        *BESIDE,
    ),
    Ratio(
        "loading",
        "shuffled transitions from disk, against PNG + `DataLoader`",
        _loader("graspq, streaming"),
        *at_least(10, 30),
    ),
    Ratio(
        "loading",
        "… every file's SHA-256 checked first",
        _loader("graspq, streaming, SHA-256 of all files first"),
        *BESIDE,
    ),
    Ratio(
        "loading",
        "… with all data in the buffer, first epoch",
        _loader("graspq, all in the buffer, first epoch"),
        *at_least(10, 30),
    ),
    Ratio("loading", "Hugging Face `datasets`, map-style", _loader("Hugging Face datasets, map-style"), *BESIDE),
    Ratio("loading", "Hugging Face `datasets`, streaming", _loader("Hugging Face datasets, streaming"), *BESIDE),
    Ratio("loading", "LeRobot-style random access", _loader("LeRobot-style random access"), *BESIDE),
    Ratio("loading", "share of a training step spent waiting for data, `mc`", _waiting("mc"), *at_most(0.05, 0.01)),
    Ratio("loading", "… `dql`", _waiting("dql"), *at_most(0.05, 0.01)),
    Ratio(
        "loading",
        "a step of `mc` on streamed batches, against one on batches that lie ready",
        _waiting("mc", "times a step on ready batches"),
        *BESIDE,
    ),
    Ratio(
        "streaming_memory",
        "growth of the memory of streaming training, data ten times the buffer",
        lambda found: row_where(found["rows"])["growth"],
        *at_most(0.02),
    ),
    Ratio("training", "training of `mc`, against the same network in plain PyTorch", _training("mc"), *at_least(2, 4)),
    Ratio("training", "… of `dql`", _training("dql"), *at_least(2, 4)),
    Ratio(
        "training",
        "… of `dql`, the plain one with a copy of the picture for every candidate",
        lambda found: row_where(found["rows"], training="dql, graspq")["times tiled copies"],
        *BESIDE,
    ),
    Ratio("training", "… of `ddpg`, against d3rlpy's own, smaller network", _training("ddpg"), *BESIDE),
    Ratio(
        "roofline",
        "operations a second of training `mc`, against those of a matrix product on the same device",
        _roofline("mc"),
        *BESIDE,
    ),
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
        *at_least(4, 8),
    ),
    Ratio("evaluation", "… one at a time, trunk each iteration", _evaluation("trunk each iteration"), *BESIDE),
    Ratio("evaluation", "… one at a time, trunk once (our network)", _evaluation("trunk once"), *BESIDE),
    Ratio(
        "time_to_quality",
        "seconds of training until ROC AUC 0.75, the paper's settings against ours",
        lambda found: found["the paper's time over ours, median"],
        *at_least(5, 15),
    ),
)


def ratio_rows(found: dict[str, Found], commands: dict[str, str]) -> list[dict[str, Any]]:
    """Return the table's rows; what was not measured says so, and a part's first row its command.

    Args:
        found: what the parts wrote, by name.
        commands: that make them, by name.
    """
    rows: list[dict[str, Any]] = []
    said: set[str] = set()
    for ratio in RATIOS:
        value = ratio.value(found[ratio.part]) if ratio.part in found else None
        number = None if value is None else float(str(value).rpartition(" ")[2])  # "at least 20" counts as 20
        rows.append(
            {
                "in one run": ratio.says,
                "measured": "not measured" if number is None else f"{number:.1%}" if "%" in ratio.bar else value,
                "bar": ratio.bar,
                "aim": ratio.aim,
                "met": "" if ratio.meets is None or number is None else "yes" if ratio.meets(number) else "**no**",
                "command": "" if ratio.part in said else f"`{commands[ratio.part]}`",
            }
        )
        said.add(ratio.part)
    return rows
