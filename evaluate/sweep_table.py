"""The table of a sweep: a row for each job, with at least `id, algo, status, steps, success_rate`.

`grasp-sweep` writes it as `sweep.jsonl` and `sweep.csv`; reports read it.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from graspq.common.checksums import DamagedError
from graspq.common.text import read_jsonl, write_csv, write_jsonl

SWEEP_FILE = "sweep.jsonl"
NEEDED = ("id", "algo", "status", "steps", "success_rate")


def write_sweep_table(folder: Path, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    """Write both files, each atomically; every row has all columns."""
    write_jsonl(folder / SWEEP_FILE, rows)
    write_csv(folder / "sweep.csv", columns, rows)


def read_sweep_table(path: Path) -> list[dict[str, Any]]:
    """Return the rows of `sweep.jsonl`.

    Raises:
        DamagedError: it is not the table of a sweep.
    """
    rows = read_jsonl(path, NEEDED, "grasp-sweep", "the table of a sweep")
    wrong = next((row for row in rows if not _is_row(row)), None)
    if wrong is not None:
        told = ", ".join(f"{name} = {wrong[name]!r}" for name in NEEDED)
        raise DamagedError(f"{path}: not the table of a sweep ({told}); run grasp-sweep again")
    return rows


def _is_row(row: Mapping[str, Any]) -> bool:
    rate, words = row["success_rate"], (row["id"], row["algo"], row["status"])
    # An id names a folder of the sweep.
    named = all(isinstance(word, str) for word in words) and Path(row["id"]).name == row["id"]
    scored = rate is None or (type(rate) in (int, float) and 0 <= rate <= 1)
    return named and scored and type(row["steps"]) is int
