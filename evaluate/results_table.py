"""The table of results, `results.jsonl` and `results.csv`: a row for each evaluation, with all that a test needs.

A row names data, recipe and code by their digests, and holds the outcome of every episode in the order of the scenes,
which task, object set, split and seed determine: whoever has the file can compute any test again.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from graspq.common.errors import UserError
from graspq.common.text import read_jsonl, write_csv, write_jsonl
from graspq.evaluate.records import Evaluation

RESULTS_FILE = "results.jsonl"
TABLE_FILE = "results.csv"  # the same for spreadsheets; written last
COLUMNS = (
    "label", "policy", "run", "algo", "training_seed", "checkpoint_step", "task", "split", "seed", "episodes", "status",
    "successes", "success_rate", "ci95_low", "ci95_high", "mean_steps", "object_set", "object_set_sha256",
    "data_sha256", "recipe_sha256", "trained_by", "scored_by", "simulator", "outcomes", "folder", "error",
)  # fmt: skip


def outcomes_text(success: Sequence[bool] | npt.NDArray[np.bool_]) -> str:
    """Return outcomes as hexadecimal digits: a bit for each episode in order, the first the highest, zeros at the end.

    Args:
        success: of each episode, bool [N].
    """
    return np.packbits(np.asarray(success, dtype=np.bool_)).tobytes().hex()


def outcomes_of(row: Mapping[str, Any]) -> npt.NDArray[np.bool_]:
    """Return the outcomes that a row's `outcomes` holds for its `episodes`, bool [N].

    Raises:
        UserError: they are not as many as its `episodes`, or their sum is not its `successes`.
    """
    bits = np.unpackbits(np.frombuffer(bytes.fromhex(row["outcomes"]), dtype=np.uint8)).astype(np.bool_)
    success: npt.NDArray[np.bool_] = bits[: row["episodes"]]
    if len(success) < row["episodes"] or len(bits) - len(success) > 7 or int(bits.sum()) != row["successes"]:
        raise UserError(f"{row.get('label')}: its outcomes are not those of {row['episodes']} episodes; write it again")
    return success


def scored(evaluation: Evaluation) -> dict[str, Any]:
    """Return what a row says of a finished evaluation.

    `trained_by` and `scored_by` are revisions of this code, `data_sha256` and `recipe_sha256` None without a run.

    Raises:
        UserError: the rows of its episodes are missing.
    """
    summary = evaluation.summary
    low, high = summary["ci95"]
    same = (
        "label", "policy", "run", "algo", "training_seed", "checkpoint_step", "task", "split", "seed", "episodes",
        "successes", "success_rate", "mean_steps", "data_sha256", "recipe_sha256", "trained_by",
    )  # fmt: skip
    return {name: summary.get(name) for name in same} | {
        "ci95_low": low,
        "ci95_high": high,
        "object_set": summary["object_set"]["name"],
        "object_set_sha256": summary["object_set"]["sha256"],
        "scored_by": summary["code_revision"],
        "simulator": " ".join(f"{name} {version}" for name, version in summary["job"].get("simulator", {}).items()),
        "outcomes": outcomes_text([row.success for row in evaluation.rows()]),
        "folder": evaluation.folder.as_posix(),
    }


def write_results(folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write both files, each atomically; a row may lack columns."""
    complete = [dict.fromkeys(COLUMNS) | dict(row) for row in rows]
    write_jsonl(folder / RESULTS_FILE, complete)
    write_csv(folder / TABLE_FILE, COLUMNS, complete)


def read_results(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a `results.jsonl`.

    Raises:
        UserError: it is not a table of grasp-eval, or lacks a column.
    """
    return read_jsonl(path, COLUMNS, "grasp-eval", "a table of grasp-eval of today")
