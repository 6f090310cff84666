"""Folders on their way to workers that share no disk: packed to bytes, unpacked once a node into the user's cache.

The place in the cache is named by the content, so that a folder which is there already is not fetched again.
"""

import hashlib
import io
import os
import shutil
import tarfile
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from graspq.common.files import TEMPORARY_PREFIX, cache_folder, committed, committed_folder, writable_folder

_KEPT_SECONDS = 14 * 24 * 3600


def packed(folder: Path, parts: Sequence[Path] | None = None) -> bytes:
    """Return a folder, or those of some parts of it that are there, as a tar archive.

    The same names and contents give the same bytes. Links, and what is no file or folder, are left out.
    """
    roots = [folder] if parts is None else parts
    inside = {path for root in roots for path in (root, *root.rglob("*")) if path != folder}
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w", format=tarfile.PAX_FORMAT) as archive:
        for path in sorted(inside):
            if path.is_symlink() or not (path.is_file() or path.is_dir()):
                continue
            entry = tarfile.TarInfo(str(path.relative_to(folder)))
            entry.mode = 0o755 if path.is_dir() else 0o644
            if path.is_dir():
                entry.type = tarfile.DIRTYPE
                archive.addfile(entry)
            else:
                data = path.read_bytes()
                entry.size = len(data)
                archive.addfile(entry, io.BytesIO(data))
    return content.getvalue()


def digest_of(content: bytes) -> str:
    """Return the name of a packed folder in the cache."""
    return hashlib.sha256(content).hexdigest()


def unpack(content: bytes, folder: Path) -> None:
    """Write the files of a packed folder into `folder`."""
    with tarfile.open(fileobj=io.BytesIO(content)) as archive:
        archive.extractall(folder, filter="data")


def unpack_parts(content: bytes, folder: Path, parts: Iterable[Path]) -> None:
    """Put parts of a packed folder where they belong in `folder`; each takes the place of an older one as a whole."""
    with tempfile.TemporaryDirectory(prefix=TEMPORARY_PREFIX, dir=writable_folder(folder, "parts")) as temporary:
        unpack(content, Path(temporary))
        for part in parts:
            found = Path(temporary) / part.relative_to(folder)
            if found.exists():
                with committed_folder(part, replace=True) if found.is_dir() else committed(part) as place:
                    found.replace(place)


def received(digest: str, fetch: Callable[[], bytes]) -> Path:
    """Return this machine's copy of a packed folder, which is fetched if it is not there; safe in several processes.

    Copies that nobody has used for two weeks are removed.
    """
    place = cache_folder("shipped", digest)
    if not place.is_dir():
        with committed_folder(place) as temporary:
            unpack(fetch(), temporary)
        _remove_unused(place.parent)
    os.utime(place)
    return place


def _remove_unused(shipped: Path) -> None:
    for copy in shipped.iterdir():
        if copy.stat().st_mtime < time.time() - _KEPT_SECONDS:
            shutil.rmtree(copy, ignore_errors=True)
