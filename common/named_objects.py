"""Objects that a user names as `module:name`: their own policies, tasks, estimators and networks.

The module may lie in the working folder. Naming one runs its code.
"""

import importlib
import os
import sys
import traceback
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from graspq.common.errors import UserError
from graspq.common.files import sha256_of

Row = TypeVar("Row")


def named_module(name: str) -> ModuleType:
    """Import a module by its name, from the working folder too; whatever it raises on import is raised here."""
    here = str(Path.cwd())
    # At the end: what is installed keeps its names, whatever the working folder holds.
    sys.path.append(here)
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(here)


def named_object(name: str, what: str) -> Any:
    """Return what `module:name` stands for.

    Args:
        name: of the module and, after a colon, of something in it.
        what: kind of the object, for the messages, such as `"policy"`.

    Raises:
        UserError: the name has no colon, the module cannot be imported, or has nothing of that name.
    """
    module_name, _, attribute = name.partition(":")
    if not module_name or not attribute:
        raise UserError(f"{what} {name!r}: expected module:name of your own")
    try:
        module = named_module(module_name)
    except Exception as error:
        raise UserError(
            f"{what} {name}: cannot be imported, {described(error)}; run it where {module_name} is"
        ) from error
    if not hasattr(module, attribute):
        raise UserError(f"{what} {name}: {module_name} has no {attribute!r}")
    return getattr(module, attribute)


def named_row(option: str, name: str, table: Mapping[str, Row], kind: type[Row], noun: str) -> Row:
    """Return a row of a table by its name, or a user's own as `module:name`.

    Args:
        option: that names it, for the messages.
        name: a key of the table or `module:name`.
        table: ours.
        kind: what a row is.
        noun: what a row is called.

    Raises:
        UserError: there is none of that name, or what is there is no such row.
    """
    if name in table:
        return table[name]
    if ":" not in name:
        raise UserError(f"{option}: {name!r} is unknown; choose from {', '.join(table)}, or module:{noun} of your own")
    row = named_object(name, option)
    if not isinstance(row, kind):
        raise UserError(f"{option} {name}: expected {kind.__name__}, got {type(row).__name__}")
    return row


def source_digest(name: str) -> str | None:
    """Return the SHA-256 of the source file of an imported `module:name`; None where it has none."""
    source = getattr(sys.modules.get(name.partition(":")[0]), "__file__", None)
    return sha256_of(Path(source)) if source is not None and Path(source).is_file() else None


def described(error: Exception) -> str:
    """Return an error with the place it was raised at, in one line."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith("<")]
    where = f" at {os.path.relpath(frames[-1].filename)}:{frames[-1].lineno}" if frames else ""
    return " ".join(f"{type(error).__name__}: {error}{where}".split())
