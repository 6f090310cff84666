"""The scores of a study, a row for each cell, as JSON lines: all that statistics and claims are reckoned from.

The file is made anew from the cells' own files each time, never added to.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from graspq.common.text import markdown, write_jsonl
from graspq.evaluate.records import Evaluation
from graspq.evaluate.statistics import mean_over_seeds, wilson_interval
from graspq.studies.study.cells import Cell
from graspq.studies.study.freezing import key_of, read_recipe
from graspq.studies.study.plan_file import StudyPlan
from graspq.studies.sweep.trial import run_in

SCORES_FILE = "study.jsonl"


def write_scores(plan: StudyPlan, folder: Path, cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """Write the rows of all cells; return them."""
    frozen = read_recipe(plan.recipe)["rows"] if plan.recipe.exists() else {}
    rows = [row_of(plan, cell, frozen.get(key_of(cell), {}).get("digest") == cell.digest) for cell in cells]
    write_jsonl(folder / SCORES_FILE, rows)
    return rows


def row_of(plan: StudyPlan, cell: Cell, frozen: bool) -> dict[str, Any]:
    """Return what is known of a cell.

    Args:
        plan: the plan.
        cell: the cell.
        frozen: whether its settings are those of the plan's frozen recipe.
    """
    state, run = cell.state(), run_in(cell.run_folder)
    row: dict[str, Any] = {
        "study": plan.name, "row": cell.row, "algo": cell.algo, "options": dict(cell.options), "task": cell.task,
        "size": cell.size, "setting": plan.values["setting"], "seed": cell.seed, "split": plan.split,
        "recipe_sha256": cell.digest, "recipe_frozen": frozen, "status": state.status, "steps": state.steps,
        "training_seconds": state.training_seconds, "reason": state.reason,
    }  # fmt: skip
    if run is not None:
        row["data_sha256"] = run.config.get("dataset", {}).get("manifest_sha256")
        row["trained_by"] = run.config.get("code_revision")
        validations = [one["validation"] for one in run.metrics() if "validation" in one]
        row["validation"] = validations[-1] if validations else None
    return row | (scored(state.evaluation) if state.evaluation is not None else {})


def scored(evaluation: Evaluation) -> dict[str, Any]:
    """Return what a table says of an evaluation; `outcomes` has a digit for each scene in order, 1 for a success."""
    summary = evaluation.summary
    named = ("episodes", "successes", "success_rate", "ci95", "mean_steps")
    return {name: summary[name] for name in named} | {
        "object_set_sha256": summary["object_set"]["sha256"],
        "scored_by": summary["code_revision"],
        "outcomes": "".join(str(int(row.success)) for row in evaluation.rows()),
    }


def table(plan: StudyPlan, rows: Sequence[dict[str, Any]]) -> str:
    """Return the table by row, size and task in Markdown: means over seeds, in the plan's order."""
    lines = []
    for (row, task, size), some in grouped(rows).items():
        done = [one for one in some if one["status"] == "done"]
        rates = [one["success_rate"] for one in done]
        lines.append([f"`{row}`", task, size, *_success(rates, done), f"{len(done)} of {len(some)}", _status(some)])
    return markdown(["row", "task", "size", f"success on {plan.split}", "95 % interval", "seeds", ""], lines)


def grouped(rows: Sequence[dict[str, Any]]) -> dict[tuple[str, str, str], list[dict[str, Any]]]:
    """Return rows of all seeds by row, task and size."""
    found: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for one in rows:
        found.setdefault((one["row"], one["task"], one["size"]), []).append(one)
    return found


def _success(rates: Sequence[float], done: Sequence[dict[str, Any]]) -> list[str]:
    if not rates:
        return ["", ""]
    mean = mean_over_seeds(rates)
    low, high = mean.low, mean.high
    if low is None or high is None:
        low, high = wilson_interval(done[0]["successes"], done[0]["episodes"])
    return [f"{mean.mean:.3f}", f"{max(low, 0.0):.3f} to {min(high, 1.0):.3f}"]


def _status(some: Sequence[dict[str, Any]]) -> str:
    reasons = [f"seed {one['seed']} failed: {one['reason']}" for one in some if one["status"] == "failed"]
    return "; ".join(reasons)
