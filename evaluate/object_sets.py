"""Which object set an evaluation draws from, when the user does not say.

A run remembers its data by their manifests: the object set is looked for beside those data, and recognised by digest;
then comes the task's own.
"""

from collections.abc import Iterable
from pathlib import Path

from graspq.common.errors import UserError
from graspq.common.files import sha256_of
from graspq.objects.defaults import default_object_set
from graspq.objects.object_set import ObjectSet
from graspq.sim.task import Task

SET_FILE = "object_set.json"


def find_object_set(
    task: Task, asked: Path | None, wanted: str | None, datasets: Iterable[Path] = (), others: Iterable[Path] = ()
) -> ObjectSet:
    """Return the object set of an evaluation, its files verified.

    Args:
        task: of the evaluation.
        asked: the folder the user named, an object set or a dataset that holds one.
        wanted: SHA-256 of the set that the run's data were made with, if known.
        datasets: folders of the datasets that the run was trained on.
        others: folders of sets that other jobs of the same plan use.

    Raises:
        UserError: the task has none of its own, it is damaged, or it is another one than the run's.
    """
    if asked is not None:
        folder = (
            asked if (asked / SET_FILE).is_file() or not (asked / "objects" / SET_FILE).is_file() else asked / "objects"
        )
        return _verified(folder)
    candidates = [*(folder / "objects" for folder in datasets), *others]
    for folder in candidates:
        if (folder / SET_FILE).is_file() and wanted in (None, sha256_of(folder / SET_FILE)):
            return _verified(folder)
    own = default_object_set(task.object_set)
    if wanted not in (None, own.digest()):
        raise UserError(
            f"{own.folder}: not the object set of the run's data ({wanted}); name one with --objects FOLDER"
        )
    return _verified(own.folder)


def _verified(folder: Path) -> ObjectSet:
    objects = ObjectSet.load(folder)
    objects.verify()
    return objects
