"""The table of a sweep: a row for each job, with at least `id, algo, status, steps, success_rate`.

`grasp-sweep` writes it as `sweep.jsonl` and `sweep.csv`; reports read it.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

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
        UserError: it is not the table of a sweep.
    """
    return read_jsonl(path, NEEDED, "grasp-sweep", "the table of a sweep")
