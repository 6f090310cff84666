"""Mistakes of a user and failures of the machine, as opposed to defects of ours.

Both are a `CommandError`, which ends a command with one line: a `UserError` with exit status 2, a `MachineError` with
74. Every other exception is a defect and keeps its traceback.
"""

import contextlib
import errno
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import click


class CommandError(click.ClickException):
    """What ends a command with one line and no traceback."""


class UserError(CommandError, ValueError):
    """A mistake in what the user gave: the message names the value, what was expected and what to do.

    It is a `ValueError` too, so that library callers need not know click.
    """

    exit_code = 2


class MachineError(CommandError):
    """The machine failed, not the user: a disk that is full or broken, too little memory.

    The same command goes on once that is mended. It is no `UserError`: who passes over a file that is not what was
    expected does not pass over one that the disk did not give.
    """

    exit_code = 74  # EX_IOERR of sysexits.h


_FULL = "free some space, then run the same command again"
_RIGHTS = "choose another folder or change its rights"
_REMEDIES = {
    errno.ENOSPC: _FULL,
    errno.EDQUOT: _FULL,
    errno.EIO: "check the disk, then run the same command again",
    errno.ESTALE: "check the disk, then run the same command again",
    errno.EROFS: _RIGHTS,
    errno.EACCES: _RIGHTS,
    errno.EPERM: _RIGHTS,
    errno.EMFILE: "raise the limit of open files (ulimit -n)",
    errno.ENFILE: "raise the machine's limit of open files",
    errno.ENOMEM: "free some memory, then run the same command again",
    errno.ENAMETOOLONG: "choose a shorter name",
}


def failure_of_machine(error: BaseException) -> MachineError | None:
    """Return an exception as a failure of the machine, which says what to do; None where it is none of that."""
    if isinstance(error, MachineError):
        return error
    if isinstance(error, OSError) and error.errno in _REMEDIES:
        where = f"{os.fsdecode(error.filename)}: " if isinstance(error.filename, str | bytes | os.PathLike) else ""
        return MachineError(f"{where}{os.strerror(error.errno)}; {_REMEDIES[error.errno]}")
    if isinstance(error, RuntimeError) and "can't start new thread" in str(error):
        return MachineError("not enough memory or threads; free some, or lift their limits, then run the command again")
    # PyTorch says so with a RuntimeError, a library that is imported with an ImportError, pyarrow with nothing where it
    # has no memory to import pandas.
    said = {
        RuntimeError: "can't allocate memory", ImportError: "failed to map segment",
        SystemError: "error return without exception set",
    }  # fmt: skip
    if isinstance(error, MemoryError) or any(isinstance(error, kind) and said[kind] in str(error) for kind in said):
        return MachineError("not enough memory; free some, or lift its limit, then run the same command again")
    return None


def told(error: BaseException, message: str) -> CommandError:
    """Return the error that tells a message on an exception: a `MachineError` where the machine failed.

    So a sweep does not note a trial as failed for a disk that did not answer.
    """
    return (UserError if failure_of_machine(error) is None else MachineError)(message)


@contextlib.contextmanager
def naming(path: Path, instead: Path | None = None) -> Iterator[None]:
    """Let failures of the system inside say that they are of `path`: those of a write or an fsync name no file.

    Args:
        path: what is written or read.
        instead: a temporary name of it, which is not to be told.
    """
    try:
        yield
    except OSError as error:
        if error.errno is not None:
            named = error.filename
            if named is None:
                error.filename = str(path)
            elif instead is not None and isinstance(named, str | os.PathLike):
                inside = os.path.relpath(os.fspath(named), instead)
                if inside != os.pardir and not inside.startswith(os.pardir + os.sep):
                    error.filename = os.path.normpath(path / inside)
        raise


@contextlib.contextmanager
def said_of(where: Path | str) -> Iterator[None]:
    """Let mistakes that are found inside name the file that they stand in, as far as they do not yet.

    Args:
        where: the file, and the place in it if need be.
    """
    try:
        yield
    except UserError as error:
        if str(where) in error.message:
            raise
        raise type(error)(f"{where}: {error.message}") from None


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
