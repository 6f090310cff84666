"""Files and folders that are either wholly there or not there: written under a temporary name, synced, renamed.

After a crash at any moment a reader sees the old one or the new one, never a part of one.
"""

import contextlib
import errno
import fcntl
import glob
import hashlib
import json
import os
import shutil
import socket
import stat
import tempfile
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
import filelock

from graspq.common.errors import UserError, failure_of_machine, naming, told

TEMPORARY_PREFIX = ".tmp-"
_NAME_BYTES = 160  # of the 255 of a name, beside a host's 64
LOCK_NAME = ".lock"
LOCK_SECONDS = 10.0  # more than the engine gives a worker whose parent is gone


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's bytes as 64 hexadecimal digits."""
    with naming(path), path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def fsync_folder(folder: Path) -> None:
    """Make a rename inside `folder` durable; the content of a file likewise."""
    with naming(folder):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def make_folder(folder: Path) -> None:
    """Make a folder, and those above it, durably; one that is there is kept."""
    new = [one for one in (folder, *folder.parents) if not one.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for one in new:
        fsync_folder(one.parent)


@contextlib.contextmanager
def committed(path: Path, verify: Callable[[Path], None] | None = None) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on leaving without an error, sync it, verify it and rename it to `path`.

    Args:
        path: the final place; its folder is made if need be.
        verify: reads the finished temporary file back and raises if it is not what was meant.

    Raises:
        Whatever the body or `verify` raises; the temporary file is then removed and `path` is untouched.
    """
    make_folder(path.parent)
    _remove_orphans(path)
    temporary = _temporary(path)
    try:
        with naming(path, temporary):
            yield temporary
            fsync_folder(temporary)
            if verify is not None:
                verify(temporary)
            temporary.replace(path)
            fsync_folder(path.parent)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def committed_folder(
    path: Path, *, replace: bool = False, compare: Callable[[Path, Path], None] | None = None
) -> Iterator[Path]:
    """Yield an empty temporary folder beside `path`; on leaving without an error, sync it and rename it to `path`.

    Where `path` is already there and not empty, made by a faster process or long ago, that one is kept and the new
    one dropped, unless `replace` is set.

    Args:
        path: the final place; its parent is made if need be.
        replace: the new folder takes the place of one that is there. A process that is killed between two renames
            leaves neither, so the name must be one that can be made again.
        compare: called with the new folder and the one that is there, where that one is kept; raises if they differ.

    Raises:
        Whatever the body or `compare` raises; the temporary folder is then removed and `path` is untouched.
    """
    make_folder(path.parent)
    _remove_orphans(path)
    temporary = _temporary(path)
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        with naming(path, temporary):
            temporary.mkdir()
            yield temporary
            for part in [*temporary.rglob("*"), temporary]:
                fsync_folder(part)
            if replace and path.exists():
                remove_folder(path)
            try:
                temporary.replace(path)
            except OSError as error:
                if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                    raise
                if compare is not None:
                    compare(temporary, path)
            fsync_folder(path.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def remove_folder(path: Path) -> None:
    """Remove a folder so that a reader finds it whole or not at all: it first takes a temporary name."""
    leaving = path.with_name(f"{_temporary(path).name}-old")
    path.replace(leaving)
    fsync_folder(path.parent)  # before its files go, else a power cut may leave the name with a part of them
    shutil.rmtree(leaving, ignore_errors=True)


def _temporary(path: Path) -> Path:
    return path.parent / f"{TEMPORARY_PREFIX}{socket.gethostname()}-{os.getpid()}-{_short(path.name)}"


def _short(name: str) -> str:
    """Return a name that leaves room for what stands before it: a file's may have 255 bytes."""
    digest = hashlib.sha256(os.fsencode(name)).hexdigest()[:16]
    return name if len(os.fsencode(name)) <= _NAME_BYTES else digest


def _remove_orphans(path: Path) -> None:
    """Remove what writers of `path` that were killed on this machine have left beside it."""
    mine = f"{TEMPORARY_PREFIX}{socket.gethostname()}-"
    for leftover in path.parent.glob(f"{glob.escape(mine)}*-{glob.escape(_short(path.name))}*"):
        owner = leftover.name.removeprefix(mine).split("-")[0]
        if owner.isdigit() and not _alive(int(owner)):
            _remove(leftover)


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


@contextlib.contextmanager
def locked(folder: Path, what: str) -> Iterator[None]:
    """Hold `folder` for this process alone; a process that is killed holds nothing any more.

    The lock is the library filelock's, which PyTorch needs anyway: flock on an empty file `.lock` that stays there. A
    worker whose parent was killed holds its folder until it has kept what it has: it is waited for, `LOCK_SECONDS`.

    Args:
        folder: the folder, which is there and can be written to.
        what: what works in it, such as `"grasp-datagen"`.

    Raises:
        UserError: another process holds it all that time, or it cannot be locked.
        MachineError: it cannot be locked, as the disk does not answer or its rights are others.
    """
    lock = filelock.FileLock(folder / LOCK_NAME)
    try:
        try:
            lock.acquire(timeout=0)
        except filelock.Timeout:
            click.echo(f"{folder}: another {what} works here; waiting {LOCK_SECONDS:g} s for its end", err=True)
            lock.acquire(timeout=LOCK_SECONDS)
    except filelock.Timeout:
        raise UserError(
            f"{folder}: another {what} works here; wait for its end, or choose another folder with --out"
        ) from None
    except OSError as error:
        message = f"{folder}: cannot be locked for {what} ({error.strerror}); choose another folder"
        raise told(error, message) from None
    try:
        yield
    finally:
        lock.release()


@contextlib.contextmanager
def temporary_folder(what: str, path_bytes: int = 4000) -> Iterator[Path]:
    """Yield a new private folder for temporary files, which is removed on leaving.

    Those of this user's processes that were killed before they could do so are removed now. Whether the process of one
    is gone its lock tells, which ends with the process, however that ends.

    Args:
        what: it is for, such as `"workers"`; part of its name.
        path_bytes: its path has at most so many bytes, for sockets; in `/tmp` where $TMPDIR is too long for that.

    Raises:
        UserError: there is no folder for temporary files.
        MachineError: it cannot be written to.
    """
    prefix, place = f"graspq-{what}-", Path("/tmp")
    try:
        usual = Path(tempfile.gettempdir())
        place = usual if len(os.fsencode(usual / prefix)) + 8 <= path_bytes else place
        for leftover in place.glob(f"{glob.escape(prefix)}*"):
            _remove_forsaken(leftover)
        while True:
            folder = Path(tempfile.mkdtemp(prefix=prefix, dir=place))
            held = _held(folder)
            if held is not None:
                if folder.exists():
                    break
                os.close(held)  # one that sweeps was faster
    except OSError as error:
        raise told(error, f"{place}: cannot write temporary files here ({error.strerror}); set TMPDIR") from None
    owner = os.getpid()
    try:
        yield folder
    finally:
        # A forked child that drops its copy of this context, as children of multiprocessing do, leaves the folder.
        if os.getpid() == owner:
            shutil.rmtree(folder, ignore_errors=True)
        os.close(held)


def _held(folder: Path) -> int | None:
    """Return a descriptor that locks a folder, or None where another process holds it, or it is gone."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_NOFOLLOW | os.O_DIRECTORY)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def _remove_forsaken(folder: Path) -> None:
    try:
        found = folder.lstat()
    except OSError:
        return
    if found.st_uid != os.getuid() or not stat.S_ISDIR(found.st_mode):
        return
    held = _held(folder)
    if held is not None:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(held)


def cache_folder(*parts: str) -> Path:
    """Return `parts` below this user's cache of graspq: $XDG_CACHE_HOME/graspq, or ~/.cache/graspq.

    The cache itself is made; what `parts` name is not. Where it cannot be made or written to, a private folder of this
    user in the folder for temporary files takes its place.
    """
    given = os.environ.get("XDG_CACHE_HOME", "")
    base = Path(given) if Path(given).is_absolute() else Path.home() / ".cache"
    cache = base / "graspq"
    try:
        cache.mkdir(parents=True, exist_ok=True)
        usable = os.access(cache, os.W_OK | os.X_OK)
    except OSError:
        usable = False
    return (cache if usable else _private_cache()).joinpath(*parts)


def _private_cache() -> Path:
    cache = Path(tempfile.gettempdir()) / f"graspq-cache-{os.getuid()}"
    with contextlib.suppress(FileExistsError):
        cache.mkdir(mode=0o700)
    found = cache.lstat()
    if not cache.is_dir() or cache.is_symlink() or found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise UserError(f"{cache}: another user's, or open to others; set XDG_CACHE_HOME to a folder of your own")
    return cache


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically and durably (UTF-8, `\\n`)."""
    with committed(path) as temporary:
        temporary.write_bytes(text.encode())


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON, atomically; the same value gives the same bytes."""
    write_text(path, json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def content_of(path: Path) -> bytes:
    """Return the bytes of a regular file: one from a stranger may be a pipe, which would be waited for for ever.

    Raises:
        OSError: it is missing or no regular file.
        MachineError: the machine failed, which tells nothing of the file.
    """
    try:
        with naming(path):
            if not stat.S_ISREG(path.stat().st_mode):
                raise OSError(errno.EINVAL, "not a regular file")
            return path.read_bytes()
    except OSError as error:
        failure = failure_of_machine(error)
        if failure is not None:
            raise failure from None
        raise


def read_json(path: Path, what: str) -> Any:
    """Read a JSON file.

    Args:
        path: the file.
        what: what the file should be, for the message, such as `"dataset manifest"`.

    Raises:
        UserError: the file is missing, unreadable or not JSON.
        MachineError: see `content_of`.
    """
    try:
        return json.loads(content_of(path))
    except FileNotFoundError:
        raise UserError(f"{path}: no {what} here") from None
    # Text that is no UTF-8 and numbers of thousands of digits are ValueErrors too.
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{path}: not a readable {what} ({error})") from None


def read_toml(path: Path, missing: str) -> dict[str, Any]:
    """Read a TOML file that a user wrote.

    Args:
        path: the file.
        missing: what to say where there is none, such as `"no such plan"`.

    Raises:
        UserError: the file is missing, unreadable or not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"{path}: {missing}") from None
    # A ValueError is also text that is no UTF-8 and a number of thousands of digits.
    except (OSError, ValueError, RecursionError) as error:
        raise told(error, f"{path}: not a readable TOML file ({error})") from None


def remove_temporaries(folder: Path) -> None:
    """Remove the files and folders that earlier, killed writers of this module left in `folder`, nothing else.

    The caller holds the folder's lock, so that no writer is at work.
    """
    for leftover in folder.glob(f"{TEMPORARY_PREFIX}*"):
        _remove(leftover)


def _remove(leftover: Path) -> None:
    """Remove a temporary file or folder as far as that is possible; the next start tries again."""
    if leftover.is_dir() and not leftover.is_symlink():
        shutil.rmtree(leftover, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            leftover.unlink(missing_ok=True)


def writable_folder(folder: Path, what: str) -> Path:
    """Make `folder` and return it.

    Raises:
        UserError: it cannot be made or written to.
    """
    try:
        make_folder(folder)
        probe = _temporary(folder / "probe")
        _remove_orphans(folder / "probe")
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise told(error, f"{folder}: cannot write the {what} here ({error.strerror}); choose another folder") from None
    return folder
