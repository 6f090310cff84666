"""The project's own object sets, in the user's cache: made on first use, made again when their rules have changed."""

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import click

from graspq.common.errors import UserError
from graspq.common.files import cache_folder
from graspq.objects.object_set import ObjectSet
from graspq.objects.procedural import GENERATOR_VERSION, SEED, make_procedural
from graspq.objects.targeted import make_targeted

_MAKERS: dict[str, Callable[[Path], ObjectSet]] = {
    "regular": lambda folder: make_procedural(folder, seed=SEED),
    "targeted": lambda folder: make_targeted(folder, seed=SEED),
}


def default_object_set(name: str) -> ObjectSet:
    """Return the project's own set of a task, "regular" (1,100 objects) or "targeted" (13).

    It lies in the user's cache, in a folder named by the set and the version of the rules that made it. A folder that
    holds anything else, such as a set of older rules, is replaced. The first use of "regular" takes half a minute.

    Raises:
        UserError: no such set, or the cache cannot be written to.
    """
    if name not in _MAKERS:
        raise UserError(f"object set {name!r}: choose from {', '.join(_MAKERS)}, or name a folder with --objects")
    folder = cache_folder("objects", f"{name}-{GENERATOR_VERSION}")
    stale = folder.exists() or folder.is_symlink()
    try:
        there = ObjectSet.load(folder)
        if (there.generator_version, there.seed) == (GENERATOR_VERSION, SEED):
            return there
    except UserError:
        pass
    if stale and folder.is_dir() and not folder.is_symlink():
        shutil.rmtree(folder)
    elif stale:  # else another process may have made it just now
        folder.unlink(missing_ok=True)
    click.echo(f"making the {name} object set in {folder} (once)", file=sys.stderr)
    return _MAKERS[name](folder)
