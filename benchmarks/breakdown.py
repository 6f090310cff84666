"""Where the time of a grasp and of a training step goes: the tables below the ratios in `RESULTS.md`."""

from typing import Any

from ratios import Found
from timing import table

KINDS = {"Python": "Python", "IK": "IK and motors", "motor commands": "IK and motors"}


def grasp_rows(collection: Found) -> list[dict[str, Any]]:
    """Return a row for each phase of a grasp, the longest first: CPU milliseconds in PyBullet and outside it."""
    phases: dict[str, dict[str, float]] = {}
    for row in collection["Where a grasp's time goes"]:
        if row["phase"] != "all":
            kind = KINDS.get(row["what"], "PyBullet")
            sums = phases.setdefault(row["phase"], {})
            sums[kind] = sums.get(kind, 0.0) + row["CPU ms a grasp"]
    whole = sum(sum(sums.values()) for sums in phases.values())
    rows = [
        {
            "phase of a grasp": phase,
            "CPU ms": sum(sums.values()),
            "share": f"{sum(sums.values()) / whole:.0%}",
            **{kind: sums.get(kind, 0.0) for kind in ("PyBullet", "IK and motors", "Python")},
        }
        for phase, sums in phases.items()
    ]
    return sorted(rows, key=lambda row: -float(row["CPU ms"]))


def step_rows(training: Found) -> list[dict[str, Any]]:
    """Return a row for each estimator whose training step was taken apart."""
    return [
        {
            name.removesuffix(", ms") + (" (ms)" if name.endswith(", ms") else ""): (
                f"{value:.0%}" if name.startswith("share") else value
            )
            for name, value in row.items()
        }
        for row in training["where a step of ours goes, medians"]
    ]


def section(found: dict[str, Found]) -> str:
    """Return the tables of what was measured, as Markdown; empty where neither was."""
    tables = [("collection", grasp_rows, "A grasp"), ("training", step_rows, "A training step, by estimator")]
    parts = [f"{says}:\n\n{table(rows(found[name]))}" for name, rows, says in tables if name in found]
    return "\n\n".join(["### Where the time goes", *parts]) if parts else ""
