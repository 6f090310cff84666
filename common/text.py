"""Numbers and tables as people read them: bytes, durations, counts; aligned, Markdown, JSON lines and CSV."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from graspq.common.checksums import DamagedError, checked_lines, read_checked_lines
from graspq.common.files import write_text


def bytes_text(count: float) -> str:
    """Return bytes in decimal units, as disks are sold: `35.2 MB`."""
    for unit in ("B", "kB", "MB", "GB"):
        if round(count, 1) < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"


def duration_text(seconds: float) -> str:
    """Return a duration with its most fitting unit: `0.25 s`, `42 s`, `12 min`, `1.5 h`."""
    if seconds < 10:
        return f"{seconds:.2g} s"
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 100 * 60 else f"{seconds / 3600:.1f} h"


def counted(count: int, noun: str) -> str:
    """Return a number with its noun: `1 fault`, `2,000 faults`."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Return rows as lines whose columns stand under each other, two spaces apart; all rows are of one length."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown, a line a row, ending in a line break; a `|` in a cell is escaped."""
    lines = [" | ".join(cell.replace("|", "\\|") for cell in row) for row in (heads, *rows)]
    first, *others = (f"| {line} |\n" for line in lines)
    return "".join([first, "|" + "---|" * len(heads) + "\n", *others])


def write_jsonl(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write rows as JSON, one a line with its checksum, atomically."""
    write_text(path, checked_lines(rows))


def read_jsonl(path: Path, columns: Iterable[str], command: str, what: str) -> list[dict[str, Any]]:
    """Return the rows of a table that `write_jsonl` wrote.

    Args:
        path: the file.
        columns: what every row must have.
        command: that writes it, for the message.
        what: what the file should be, for the message, such as `"the table of a sweep"`.

    Raises:
        DamagedError: the file is missing or damaged, or a row lacks a column.
    """
    rows = read_checked_lines(path, f"table of {command}", f"run {command} again")
    lacking = next((name for row in rows for name in columns if name not in row), None)
    if lacking is not None:
        raise DamagedError(f"{path}: not {what} ({lacking!r} is missing); run {command} again")
    return rows


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write rows as CSV under a line of the columns' names, atomically; None is an empty cell.

    Raises:
        ValueError: a row holds what is no column.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())
