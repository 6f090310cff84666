"""A folder that is either wholly there or not there: made beside its place under a temporary name, then renamed.

A folder that holds something else is never overwritten; one that already holds the same files is left as it is.
"""

import contextlib
import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from graspq.common.errors import UserError
from graspq.common.files import TEMPORARY_PREFIX, fsync_folder, sha256_of

MANIFEST = "object_set.json"


@contextlib.contextmanager
def published(folder: Path, what: str) -> Iterator[Path]:
    """Yield an empty temporary folder beside `folder`; on leaving without an error, rename it to `folder`.

    Where `folder` already holds exactly the same files, it is kept and the temporary one dropped.

    Args:
        folder: the final place; missing, empty, or the same already.
        what: what is made, for messages.

    Raises:
        UserError: `folder` holds something else, or its parent cannot be written to.
        Whatever the body raises; the temporary folder is then removed and `folder` is untouched.
    """
    refuse_other_content(folder, what)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        _remove_leftovers(folder)
        temporary = folder.parent / f"{TEMPORARY_PREFIX}{os.getpid()}-{folder.name}"
        temporary.mkdir()
    except OSError as error:
        raise UserError(f"{folder}: cannot write the {what} here ({error.strerror}); choose another folder") from None
    try:
        yield temporary
        _sync(temporary)
        try:
            temporary.replace(folder)
        except OSError as error:
            # The folder is not empty, or another maker of the same set was faster.
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
            _require_same(temporary, folder, what)
        fsync_folder(folder.parent)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise UserError(f"{folder}: no space left for the {what}; free some or choose another folder") from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def refuse_other_content(folder: Path, what: str) -> None:
    """Raise a UserError when `folder` is a file, or holds something but no object set."""
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise UserError(f"{folder}: is not a folder; choose another one for the {what}")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / MANIFEST).is_file():
        raise UserError(f"{folder}: not empty and no object set; choose another folder or empty this one")


def _files(folder: Path) -> dict[str, Path]:
    return {str(path.relative_to(folder)): path for path in sorted(folder.rglob("*")) if path.is_file()}


def _require_same(made: Path, there: Path, what: str) -> None:
    """Raise a UserError unless the two folders hold the same files."""
    ours, theirs = _files(made), _files(there)
    if MANIFEST not in theirs or sha256_of(ours[MANIFEST]) != sha256_of(theirs[MANIFEST]):
        raise UserError(f"{there}: holds another object set; choose another folder or remove this one")
    for name, path in ours.items():
        if name not in theirs:
            raise UserError(f"{there / name}: missing from this {what}; remove {there} and make it again")
        if sha256_of(path) != sha256_of(theirs[name]):
            raise UserError(f"{there / name}: damaged; remove {there} and make it again")


def _sync(folder: Path) -> None:
    """Put all files and folders on the disk before the rename makes them visible."""
    for path in [*folder.rglob("*"), folder]:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _remove_leftovers(folder: Path) -> None:
    """Remove what earlier, killed makers of the same folder left beside it."""
    for leftover in folder.parent.glob(f"{TEMPORARY_PREFIX}*-{folder.name}"):
        owner = leftover.name.removeprefix(TEMPORARY_PREFIX).split("-")[0]
        if owner.isdigit() and not _alive(int(owner)):
            shutil.rmtree(leftover, ignore_errors=True)


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return process != os.getpid()
