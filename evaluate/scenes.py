"""The scenes of an evaluation: a function of task, object set, split, seed and the index of the episode.

A run remembers its data by their manifests: the object set is looked for beside those data, and recognised by digest.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graspq.common.errors import UserError
from graspq.common.files import sha256_of
from graspq.common.seeding import generator
from graspq.datasets.manifest import MANIFEST_NAME, Manifest
from graspq.objects.defaults import default_object_set
from graspq.objects.object_set import ObjectSet
from graspq.sim.task import Task

if TYPE_CHECKING:
    from graspq.sim.episode import GraspSimulation

SET_FILE = "object_set.json"
_PURPOSE = "evaluate/scene"


@dataclass(frozen=True)
class Scenes:
    """All that determines an evaluation's scenes, with the index of the episode.

    Attributes:
        task: what lies in the bin and what counts.
        objects: folder of the object set.
        split: split that objects are drawn from.
        seed: of the scenes.
    """

    task: Task
    objects: Path
    split: str
    seed: int

    def begin(self, simulation: "GraspSimulation", episode: int) -> None:
        """Start an episode: objects are drawn anew, loaded into an emptied world and dropped.

        Raises:
            UserError: the object set lacks the split.
        """
        rng = generator(_PURPOSE, self.seed, episode)
        simulation.load(self.task.draw(simulation.objects, self.split, rng))
        simulation.reset(rng)


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
        UserError: there is none, it is damaged, or it is another one than the run's.
    """
    if asked is not None:
        inside = asked / "objects"
        return _verified(inside if not (asked / SET_FILE).is_file() and (inside / SET_FILE).is_file() else asked)
    for folder in [*(folder / "objects" for folder in datasets), *others]:
        if (folder / SET_FILE).is_file() and wanted in (None, sha256_of(folder / SET_FILE)):
            return _verified(folder)
    own = default_object_set(task.object_set)
    if wanted not in (None, own.digest()):
        raise UserError(
            f"{own.folder}: not the object set of the run's data ({wanted}); name one with --objects FOLDER"
        )
    return _verified(own.folder)


def refuse_trained_objects(objects: ObjectSet, split: str, wanted: str | None, datasets: Iterable[Path]) -> bool:
    """Refuse to score a run as on unseen objects on some that it was trained on; `train` is never called unseen.

    Args:
        objects: that it is scored on.
        split: split that they are drawn from.
        wanted: SHA-256 of the set that the run's data were made with, if known.
        datasets: folders of the datasets that the run was trained on.

    Returns:
        Whether it is sure: the set is the run's own, whose splits are disjoint, or the run's own is there to compare.

    Raises:
        UserError: a mesh of the split is one of the run's training objects.
    """
    if split == "train" or objects.digest() == wanted:
        return True
    folders = [folder / "objects" for folder in datasets if (folder / "objects" / SET_FILE).is_file()]
    for trained in map(ObjectSet.load, folders):
        names = {trained[name].sha256[trained[name].mesh]: name for name in _of_split(trained, "train")}
        for tested in _of_split(objects, split):
            there = names.get(objects[tested].sha256[objects[tested].mesh])
            if there is not None:
                raise UserError(
                    f"{objects.folder}: {tested} of its split {split} is {there} of {trained.folder}, which the run "
                    "was trained on; name a set without it, or --split train"
                )
    return bool(folders)


def _of_split(objects: ObjectSet, split: str) -> tuple[str, ...]:
    return objects.ids(split) if split in objects.splits else ()


def _verified(folder: Path) -> ObjectSet:
    objects = ObjectSet.load(folder)
    objects.verify()
    return objects


def datasets_of(config: dict[str, Any]) -> tuple[Path, ...]:
    """Return the dataset folders that a run was trained on, as far as they are there; `config` is its `config.json`."""
    return tuple(dict.fromkeys(_dataset_folders(config["settings"]["shards"])))


def _dataset_folders(shards: Iterable[str]) -> Iterator[Path]:
    """Yield the dataset folders that folders, shard files and globs of either belong to."""
    for pattern in shards:
        path = Path(pattern)
        anchor = Path(path.anchor)
        try:
            matches = [path] if path.exists() else sorted(anchor.glob(str(path.relative_to(anchor))))
        except (OSError, ValueError, NotImplementedError):  # no path: the data are not here
            continue
        for match in matches:
            yield from (
                folder for folder in (match, *list(match.absolute().parents)[:2]) if (folder / MANIFEST_NAME).is_file()
            )


def object_set_of(config: dict[str, Any]) -> str | None:
    """Return the SHA-256 of the object set that a run's data were made with.

    None where the run does not say and the data are gone or of several sets.
    """
    known = config["dataset"].get("object_set", {}).get("sha256")
    if known is not None:
        return str(known)
    digests = set()
    for folder in datasets_of(config):
        try:
            digests.add(str(Manifest.load(folder).object_set["sha256"]))
        except (UserError, KeyError):
            continue
    return digests.pop() if len(digests) == 1 else None
