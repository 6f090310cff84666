"""Mistakes of a user, as opposed to defects of ours.

A `UserError` ends a command with one line and exit status 2; every other exception is a defect and keeps its traceback.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click


class UserError(click.ClickException, ValueError):
    """A mistake in what the user gave: the message names the value, what was expected and what to do.

    It is a `ValueError` too, so that library callers need not know click.
    """

    exit_code = 2


def refuse_other(folder: Path, what: str, theirs: Any, ours: Any, way_out: str) -> None:
    """Refuse a folder that holds something made with other settings, and name the first that differs.

    Args:
        folder: the folder.
        what: what it holds, such as `a sweep`.
        theirs: settings by name, which may hold others, as the folder has them.
        ours: those that were asked for.
        way_out: what the user can do.

    Raises:
        UserError: they differ.
    """
    names: list[str] = []
    while isinstance(theirs, Mapping) and isinstance(ours, Mapping) and theirs != ours:
        names.append(next(name for name in {**theirs, **ours} if theirs.get(name) != ours.get(name)))
        theirs, ours = theirs.get(names[-1]), ours.get(names[-1])
    if theirs != ours:
        raise UserError(f"{folder}: holds {what} with {'.'.join(names)} = {theirs}, not {ours}; {way_out}")
