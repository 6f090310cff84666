"""The folder of an object set: it appears whole or not at all, and nothing that was there is written over."""

import contextlib
import hashlib
from collections.abc import Iterator
from pathlib import Path

from graspq.common.errors import UserError, told
from graspq.common.files import committed_folder, sha256_of

MANIFEST = "object_set.json"
# Beside it, as `sha256sum --check` reads it: its own digest, which other files of a set have in it. A set that an older
# version made has none.
CHECKSUM = "object_set.json.sha256"


def checksum_text(manifest: bytes) -> str:
    """Return what stands in `object_set.json.sha256` beside an `object_set.json` of these bytes."""
    return f"{hashlib.sha256(manifest).hexdigest()}  {MANIFEST}\n"


@contextlib.contextmanager
def published(folder: Path) -> Iterator[Path]:
    """Yield an empty temporary folder; on leaving without an error, it becomes `folder`.

    Where `folder` already holds exactly the same files, it is kept and the temporary one dropped.

    Raises:
        UserError: `folder` holds something else or is damaged, or cannot be written.
        Whatever the body raises; the temporary folder is then removed and `folder` is untouched.
    """
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise UserError(f"{folder}: is not a folder; choose another one for the object set")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / MANIFEST).is_file():
        raise UserError(f"{folder}: not empty and no object set; choose another folder or empty this one")
    try:
        with committed_folder(folder, compare=_require_same) as temporary:
            yield temporary
    except OSError as error:
        raise told(
            error, f"{folder}: cannot write the object set here ({error.strerror}); choose another folder"
        ) from None


def _require_same(made: Path, there: Path) -> None:
    """Raise a UserError unless all files of `made` are also in `there`, byte for byte."""
    if not (there / MANIFEST).is_file() or sha256_of(made / MANIFEST) != sha256_of(there / MANIFEST):
        raise UserError(f"{there}: holds another object set; choose another folder or remove this one")
    for path in sorted(path for path in made.rglob("*") if path.is_file()):
        twin = there / path.relative_to(made)
        if path.name == CHECKSUM and not twin.exists():
            continue
        if not twin.is_file() or sha256_of(path) != sha256_of(twin):
            raise UserError(f"{twin}: missing or damaged; remove {there} and make it again")
