"""Has trials done by the engine's workers, each in a process of its own.

Where workers have no disk in common with us (Ray), a run folder travels to them with its trial and comes back.
"""

import contextlib
import dataclasses
import hashlib
import os
import shutil
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from graspq.common.checksums import write_checked_json
from graspq.common.errors import UserError
from graspq.common.files import cache_folder
from graspq.datasets.dataset import open_shards
from graspq.engine import LostUnitsError, Place, run
from graspq.engine.shipping import packed, unpack_parts
from graspq.studies.sweep.checks import objects_beside
from graspq.studies.sweep.settings import SweepSettings
from graspq.studies.sweep.trial import Trial, run_in, trained_steps
from graspq.train.run import Run

T = TypeVar("T", bound=Trial)
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


def hand_out(trials: Sequence[T]) -> Generator[tuple[T, str | None], None, None]:
    """Have trials done, and yield each with why it failed; see `engine.plan.HandOut`.

    Their settings differ at most in what is learned from and how long: folder, engine and threads are the same.
    """
    settings = trials[0].settings
    threads, travels = settings.threads or 1, settings.engine == "ray" and settings.workers != 0
    named = dict.fromkeys(trial.settings.shards for trial in trials)
    work = Trials(settings, travels, {shards: _files_of(shards) for shards in named})
    # Each is packed when a worker is free for it.
    of_name = {trial.name: trial for trial in trials}
    parcels = (Parcel.of(trial) if travels else Parcel(trial) for trial in trials)
    # One a worker: what the trial before it left in memory does not matter.
    ended = run(
        work, parcels, settings.where, name=lambda parcel: parcel.trial.name, units_per_worker=1,
        cpus_per_worker=threads,
    )  # fmt: skip
    try:
        with contextlib.closing(ended) as found:
            for parcel, (error, content) in found:
                if content is not None:
                    unpack_parts(content, settings.folder, parcel.trial.outputs)
                yield of_name[parcel.trial.name], error
    except LostUnitsError as lost:
        for parcel, how in lost.lost:
            reason = f"ended its worker twice ({how})"
            parcel.trial.note_failure("", 1, reason)
            yield of_name[parcel.trial.name], reason


@dataclass(frozen=True)
class Parcel:
    """A trial, and where it travels what it has made so far, packed, and the step that it has come to."""

    trial: Trial
    content: bytes | None = None
    steps: int = 0

    @classmethod
    def of(cls, trial: Trial) -> "Parcel":
        """Return a trial that travels."""
        content = packed(trial.settings.folder, trial.outputs)
        return cls(trial, content, trained_steps(run_in(trial.run_folder)))


@dataclass(frozen=True)
class Trials:
    """How trials are done; the `Work` of a sweep. Gives why a trial failed, and where it travels what it made, packed.

    Attributes:
        settings: of one of the trials, for what they have in common.
        travels: whether trials travel, and with them what they are made from.
        shards: files of the steps, by what the settings of a trial call them.
    """

    settings: SweepSettings
    travels: bool
    shards: dict[tuple[str, ...], tuple[Path, ...]]

    @property
    def datasets(self) -> list[Path]:
        """Folders that the shards lie in."""
        return list(dict.fromkeys(path.parent.parent for paths in self.shards.values() for path in paths))

    def folders(self) -> Sequence[Path]:
        """Return the datasets and the object set."""
        asked = [self.settings.objects] if self.settings.objects is not None else []
        return [*self.datasets, *asked] if self.travels else []

    @contextlib.contextmanager
    def open(self, place: Place) -> Iterator[Callable[[Parcel], tuple[str | None, bytes | None]]]:
        """Set the number of threads before anything can ask for it."""
        os.environ |= dict.fromkeys(THREAD_VARIABLES, str(self.settings.threads))
        yield lambda parcel: self._far(parcel, place) if self.travels else (_error(parcel.trial), None)

    def _far(self, parcel: Parcel, place: Place) -> tuple[str | None, bytes]:
        """Do a trial in a folder of this machine; one that a killed worker has left here is gone on with."""
        ours = hashlib.sha256(str(self.settings.folder).encode()).hexdigest()[:16]
        folder = cache_folder("sweeps", f"{ours}-{parcel.trial.name}")
        own = parcel.trial.settings
        homes = {path: path.parent.parent for path in self.shards[own.shards]}
        shards = [place(home) / path.relative_to(home) for path, home in homes.items()]
        datasets = [place(home) for home in dict.fromkeys(homes.values())]
        moved = dataclasses.replace(
            own,
            out=folder,
            shards=tuple(map(str, shards)),
            objects=place(own.objects) if own.objects is not None else objects_beside(datasets),
        )
        trial = dataclasses.replace(parcel.trial, settings=moved)
        if parcel.content is not None and parcel.steps >= trained_steps(run_in(trial.run_folder)):
            unpack_parts(parcel.content, folder, trial.outputs)
        error = _error(trial)
        _name_shards(trial.run_folder / "config.json", own.shards)
        content = Parcel.of(trial).content or b""
        shutil.rmtree(folder, ignore_errors=True)
        return error, content


def _files_of(shards: tuple[str, ...]) -> tuple[Path, ...]:
    """Return the files of the steps that a trial learns from."""
    return tuple(dict.fromkeys(ref.path.absolute() for ref in open_shards(shards, verify=False).blocks))


def _error(trial: Trial) -> str | None:
    try:
        trial.run()
    except UserError as error:
        return error.message
    return None


def _name_shards(path: Path, shards: Sequence[str]) -> None:
    """Let the configuration of a run name the data as the sweep does, not as the worker's copies."""
    if path.exists():
        config = Run.open(path.parent).config
        config["settings"]["shards"] = list(shards)
        write_checked_json(path, config)
