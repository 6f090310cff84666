"""The one table of a sweep: a row for each trial, as CSV, as JSON lines and in Markdown.

It is made anew from the trials' own files each time, never added to.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from graspq.common.text import markdown
from graspq.evaluate.sweep_table import write_sweep_table
from graspq.studies.sweep.trial import State

OUTCOME = (
    "status", "steps", "success_rate", "ci95_low", "ci95_high", "successes", "episodes", "training_seconds", "reason",
)  # fmt: skip


def varied(states: Sequence[State]) -> tuple[str, ...]:
    """Return the names of the options that vary, in the order in which trials name them."""
    return tuple(dict.fromkeys(name for state in states for name, _ in state.trial.options))


def row_of(state: State, names: Sequence[str]) -> dict[str, Any]:
    """Return a trial's row, with the options `names`; what is not known yet, or not used, is None."""
    trial = state.trial
    row: dict[str, Any] = {"id": trial.name, "algo": trial.algo, **dict.fromkeys(names), "seed": trial.seed}
    row |= {name: _value(text) for name, text in trial.options} | dict.fromkeys(OUTCOME)
    row |= {name: getattr(state, name) for name in ("status", "steps", "training_seconds", "reason")}
    if state.evaluation is not None:
        summary = state.evaluation.summary
        row |= {name: summary[name] for name in ("success_rate", "successes", "episodes")}
        row["ci95_low"], row["ci95_high"] = summary["ci95"]
    return row


def _value(text: str) -> int | float | str:
    """Return an option's value as a number, where it is one."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def write_tables(folder: Path, states: Sequence[State]) -> None:
    """Write `sweep.jsonl` and `sweep.csv`, each atomically."""
    names = varied(states)
    write_sweep_table(folder, ("id", "algo", *names, "seed", *OUTCOME), [row_of(one, names) for one in states])


def as_markdown(states: Sequence[State]) -> str:
    """Return the table in Markdown: estimators in the plan's order, within each by success, what failed last.

    A column in which no trial has a value is left out.
    """
    order = {algo: index for index, algo in enumerate(dict.fromkeys(state.trial.algo for state in states))}
    names = varied(states)
    rows = sorted((row_of(state, names) for state in states), key=lambda row: (order[row["algo"]], *_rank(row)))
    used = [name for name in ("algo", *names, "seed") if any(row[name] is not None for row in rows)]
    heads = [name.replace("_", " ") for name in used] + ["success", "95 % interval", "steps", "training", "status"]
    return markdown(heads, [[*(_text(row[name]) for name in used), *_outcome(row)] for row in rows])


def _rank(row: dict[str, Any]) -> tuple[int, float]:
    place = {"done": 0, "to do": 1, "failed": 2}[row["status"]]
    return place, -row["success_rate"] if row["success_rate"] is not None else 0.0


def _text(value: Any) -> str:
    if value is None:
        return ""
    return f"`{value}`" if isinstance(value, str) else f"{value:.12g}"


def _outcome(row: dict[str, Any]) -> list[str]:
    done = row["success_rate"] is not None
    seconds = row["training_seconds"]
    return [
        f"{row['success_rate']:.3f}" if done else "",
        f"{row['ci95_low']:.3f} to {row['ci95_high']:.3f}" if done else "",
        f"{row['steps']:,}",
        f"{seconds:,.0f} s" if seconds is not None else "",
        "failed: " + row["reason"] if row["status"] == "failed" else row["status"],
    ]


def line_of(state: State) -> str:
    """Return what became of a trial in one line, for the terminal."""
    if state.evaluation is None:
        outcome = f"failed: {state.reason}" if state.reason is not None else "stopped; the same command goes on with it"
        return f"{state.trial.name}: {outcome}"
    summary = state.evaluation.summary
    low, high = summary["ci95"]
    seconds = f", {state.training_seconds:,.0f} s of training" if state.training_seconds is not None else ""
    return f"{state.trial.name}: {100 * summary['success_rate']:.1f} % ({100 * low:.1f} to {100 * high:.1f}){seconds}"
