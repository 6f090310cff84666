"""JSON that tells whether it is as it was written: the last entry of a file, or of a line, is its own checksum.

`"checksum"` is the first 16 hexadecimal digits of the SHA-256 of the text with an empty one in its place. Nothing else
changes: people and other programs read the file as before. What older versions wrote has none, and is not checked.
"""

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from graspq.common.errors import UserError
from graspq.common.files import content_of, write_text

ENTRY = "checksum"
_DIGITS = 16
_LAST_ENTRY = re.compile(rb'"checksum": "([0-9a-f]{16})"(\s*\}\s*)\Z')


class DamagedError(UserError):
    """A file that is not as it was written."""


def with_checksum(value: Mapping[str, Any], indent: int | None = None) -> str:
    """Return a JSON object as text whose last entry is its checksum, with an end of line.

    Raises:
        ValueError: it holds a number that is not finite, or an entry `checksum`.
    """
    if ENTRY in value:
        raise ValueError(f"expected no entry {ENTRY!r}")
    # Files as people read them; lines in ASCII, so that no reader finds another end of line in them.
    text = json.dumps({**value, ENTRY: ""}, indent=indent, ensure_ascii=indent is None, allow_nan=False) + "\n"
    place = text.rindex('""') + 1
    return text[:place] + _checksum(text.encode()) + text[place:]


def checked(content: bytes) -> tuple[Any, bool]:
    """Return what a text of JSON says, without its checksum, and whether it has one.

    Raises:
        ValueError: it is no JSON, or not what its checksum was taken of.
        RecursionError: it is nested too deeply.
    """
    value = json.loads(content)
    if not isinstance(value, dict) or ENTRY not in value:
        return value, False
    found = _LAST_ENTRY.search(content)
    # Only a text that ends in the checksum was written by `with_checksum`.
    blank = content[: found.start(1)] + content[found.end(1) :] if found is not None else b""
    if found is None or found[1].decode() != _checksum(blank):
        raise ValueError("its checksum is not that of its content")
    return {name: entry for name, entry in value.items() if name != ENTRY}, True


def _checksum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:_DIGITS]


def write_checked_json(path: Path, value: Mapping[str, Any]) -> None:
    """Write an object as indented JSON with its checksum, atomically; the same value gives the same bytes."""
    write_text(path, with_checksum(value, indent=2))


def read_checked_json(path: Path, what: str, remedy: str) -> dict[str, Any]:
    """Return the object that `write_checked_json` wrote.

    Args:
        path: the file.
        what: what the file should be, for the message, such as `"training run"`.
        remedy: what the user can do about a damaged file.

    Raises:
        UserError: there is no such file.
        MachineError: see `files.content_of`; so do all that read a file here.
        DamagedError: it cannot be read, or is not as it was written.
    """
    try:
        value, _ = checked(content_of(path))
        if not isinstance(value, dict):
            raise ValueError("expected an object")
    except (FileNotFoundError, NotADirectoryError):
        raise UserError(f"{path}: no {what} here") from None
    # Text that is no UTF-8 and numbers of thousands of digits are ValueErrors too.
    except (OSError, ValueError, RecursionError) as error:
        raise DamagedError(f"{path}: damaged, not a readable {what} ({error}); {remedy}") from None
    return value


def checked_lines(rows: Iterable[Mapping[str, Any]]) -> str:
    """Return rows as JSON lines, each with its checksum."""
    return "".join(map(with_checksum, rows))


def read_checked_lines(path: Path, what: str, remedy: str, *, grows: bool = False) -> list[dict[str, Any]]:
    """Return the rows of a file that `checked_lines` made.

    Args:
        path: the file.
        what: what the file should be, for the message.
        remedy: what the user can do about a damaged file.
        grows: lines are added to it one by one, and the last may have been cut short by a crash: it is left out.

    Raises:
        DamagedError: it cannot be read, or a line is not as it was written.
    """
    try:
        *lines, last = content_of(path).split(b"\n")
    except OSError as error:
        raise DamagedError(f"{path}: damaged or missing, not a readable {what} ({error.strerror}); {remedy}") from None
    if last and not (grows and _cut_short(last)):
        lines.append(last)
    rows, have = list[dict[str, Any]](), set[bool]()
    for number, line in enumerate(lines, start=1):
        try:
            row, has_one = checked(line + b"\n")
            if not isinstance(row, dict):
                raise ValueError("expected an object")
            rows.append(row)
            have.add(has_one)
            # A file has checksums from its first line on, or it is of an older version and has none.
            if len(have) > 1:
                raise ValueError("some lines have a checksum and some have none")
        except (ValueError, RecursionError) as error:
            raise DamagedError(f"{path}: damaged, not a readable {what}, line {number} ({error}); {remedy}") from None
    return rows


def _cut_short(line: bytes) -> bool:
    """Return whether a last line without an end is the beginning of one, rather than a whole one and something else."""
    for end in (len(line), len(line) - 1):
        try:
            json.loads(line[:end])
        except (ValueError, RecursionError):
            continue
        return False
    return True
