"""How the benchmarks measure: rivals take turns in one process, and ratios are taken within a turn.

A machine that others share slows all rivals of a turn alike; the median of the turns' ratios hardly moves.
"""

import datetime
import json
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from graspq.common.provenance import code_revision, versions

PACKAGES = ("torch", "pybullet", "numpy", "pyarrow", "datasets", "d3rlpy")


def take_turns(rivals: Mapping[str, Callable[[], Any]], turns: int) -> dict[str, list[float]]:
    """Return the seconds of every rival in every turn, after one that is not counted; every other turn is backwards."""
    seconds: dict[str, list[float]] = {name: [] for name in rivals}
    for turn in range(turns + 1):
        for name, run in list(rivals.items())[:: 1 if turn % 2 else -1]:
            start = time.perf_counter()
            run()
            if turn > 0:
                seconds[name].append(time.perf_counter() - start)
    return seconds


def median_ratio(over: list[float], under: list[float]) -> float:
    """Return the median over turns of over / under."""
    return statistics.median(a / b for a, b in zip(over, under, strict=True))


def table(rows: list[dict[str, Any]]) -> str:
    """Return rows of equal keys as a Markdown table."""
    names = list(rows[0])
    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    lines += ["| " + " | ".join(_shown(row[name]) for name in names) + " |" for row in rows]
    return "\n".join(lines)


def report(title: str, rows: list[dict[str, Any]], facts: dict[str, Any], out: Path | None) -> None:
    """Print a benchmark's table, and write it as JSON where `out` is given; a fact may be rows of a further table.

    When it was measured, and with what code, is added.
    """
    print(f"{title}\n{table(rows)}")
    for name, value in facts.items():
        print(f"\n{name}\n{table(value)}" if isinstance(value, list) else f"{name}: {_shown(value)}")
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        day = datetime.datetime.now(datetime.UTC).date().isoformat()
        measured = {"on": day, "code_revision": code_revision(), "versions": versions(*PACKAGES)}
        out.write_text(json.dumps({"title": title, "rows": rows, **facts, "measured": measured}, indent=2) + "\n")


def _shown(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
