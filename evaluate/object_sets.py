"""Which object set an evaluation draws from, when the user does not say.

A run remembers its data by their manifests: the object set is looked for beside those data, and recognised by digest.
"""

from collections.abc import Iterable
from pathlib import Path

from graspq.common.errors import UserError
from graspq.common.files import sha256_of
from graspq.objects.object_set import ObjectSet

SET_FILE = "object_set.json"
DEFAULT_FOLDER = Path("data/objects")


def find_object_set(
    task: str, asked: Path | None, wanted: str | None, datasets: Iterable[Path] = (), others: Iterable[Path] = ()
) -> ObjectSet:
    """Return the object set of an evaluation, its files verified.

    Args:
        task: name of the task.
        asked: the folder the user named, an object set or a dataset that holds one.
        wanted: SHA-256 of the set that the run's data were made with, if known.
        datasets: folders of the datasets that the run was trained on.
        others: folders of sets that other jobs of the same plan use.

    Raises:
        UserError: there is none, it is damaged, or it is another one than the run's.
    """
    if asked is not None:
        folder = (
            asked if (asked / SET_FILE).is_file() or not (asked / "objects" / SET_FILE).is_file() else asked / "objects"
        )
        return _verified(folder)
    candidates = [*(folder / "objects" for folder in datasets), *others, DEFAULT_FOLDER / task]
    present = [folder for folder in candidates if (folder / SET_FILE).is_file()]
    for folder in present:
        if wanted is None or sha256_of(folder / SET_FILE) == wanted:
            return _verified(folder)
    make = f"make it with: grasp-objects make {'procedural' if task == 'regular' else task} {DEFAULT_FOLDER / task}"
    if present:
        raise UserError(
            f"{present[0]}: not the object set of the run's data ({wanted}); name one with --objects FOLDER"
        )
    raise UserError(
        f"no object set for the {task} task in {DEFAULT_FOLDER / task}; name one with --objects FOLDER or {make}"
    )


def _verified(folder: Path) -> ObjectSet:
    objects = ObjectSet.load(folder)
    objects.verify()
    return objects
