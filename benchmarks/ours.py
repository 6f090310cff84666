"""Our collection as parts of a benchmark: blocks and shards by the code that `grasp-datagen` runs."""

import contextlib
import dataclasses
import itertools
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from memory import resident_bytes
from phases import Stopwatch
from tallies import Tally

from graspq.datagen.collect import collect_block
from graspq.datagen.making import describe
from graspq.datagen.settings import CollectionSettings, DatagenSettings
from graspq.datasets import writer
from graspq.datasets.episode import Episode
from graspq.datasets.manifest import Manifest
from graspq.objects.object_set import ObjectSet
from graspq.sim import camera, cell, episode, kinematics
from graspq.sim.bullet import bullet
from graspq.sim.task import TASKS

TASK = TASKS["regular"]


class Shards:
    """A dataset in a folder, to which shards of any number of blocks are added."""

    def __init__(self, folder: str, objects: Path, settings: CollectionSettings) -> None:
        described = describe(DatagenSettings(seed=settings.seed), TASK, ObjectSet.load(objects))
        # Blocks of another size than the command's are for measuring memory; the writer checks against the manifest.
        self.folder, self.manifest = Path(folder), dataclasses.replace(described, settings=settings.described())
        self.manifest.save(self.folder)

    def add(self, episodes: Sequence[Episode]) -> Manifest:
        """Write the episodes of consecutive blocks as a shard and list it."""
        first, last = episodes[0].block, episodes[-1].block
        entry = writer.write_shard(self.folder, self.manifest, first, last - first + 1, episodes)
        self.manifest = writer.commit_shard(self.folder, self.manifest, entry)
        return self.manifest


def tally(episodes: Sequence[Episode], core_seconds: float) -> Tally:
    """Return what some episodes came to; the frame after the lift is not rendered in a collection."""
    actions = sum(one.steps for one in episodes)
    return Tally(core_seconds, len(episodes), actions, actions, sum(bool(one.success) for one in episodes))


@contextlib.contextmanager
def collection(objects: Path, seed: int, blocks: int) -> Iterator[Callable[[], list[Episode]]]:
    """Give what collects `blocks` whole blocks at each call, always the next ones, and writes their shard."""
    settings = CollectionSettings(seed=seed)
    with tempfile.TemporaryDirectory() as folder, episode.GraspSimulation(TASK, ObjectSet.load(objects)) as simulation:
        shards, starts = Shards(folder, objects, settings), itertools.count(0, blocks)

        def collect() -> list[Episode]:
            first = next(starts)
            made = [collect_block(simulation, settings, first + more, settings.block_size) for more in range(blocks)]
            done = list(itertools.chain.from_iterable(made))
            shards.add(done)
            return done

        yield collect


def collecting(objects: Path, seed: int, blocks: int) -> Iterator[Tally | None]:
    """A player's part: `blocks` whole blocks at a time, and the shard that they make."""
    with collection(objects, seed, blocks) as collect:
        yield None
        while True:
            start = time.process_time()
            done = collect()
            yield tally(done, time.process_time() - start)


def watch_collection(watch: Stopwatch) -> None:
    """Put a stopwatch around the phases of a grasp, and around the calls into native code and the kinematics."""
    simulation = episode.GraspSimulation
    for owner, name, phase in (
        (simulation, "load", "loading the bin"),
        (cell, "drop", "settling"),
        (cell, "settle", "settling"),
        (simulation, "step", "moving"),
        (simulation, "_close_and_lift", "grasping and lifting"),
        (camera.Camera, "render", "rendering"),
        (writer, "write_shard", "writing"),
        (writer, "commit_shard", "writing"),
    ):
        watch.as_phase(owner, name, phase)
    for owner, name, what in (
        (bullet, "stepSimulation", "physics"),
        (bullet, "setJointMotorControlArray", "motor commands"),
        (bullet, "getCameraImage", "TinyRenderer"),
        (bullet, "loadURDF", "reading URDFs"),
        (bullet, "resetSimulation", "emptying the world"),
        (kinematics, "joint_angles", "IK"),
    ):
        watch.as_part(owner, name, what)


@dataclasses.dataclass(frozen=True)
class Profile:
    """Seconds, CPU seconds and calls of every (phase, what) in some grasps."""

    grasps: int
    seconds: dict[tuple[str, str], float]
    core_seconds: dict[tuple[str, str], float]
    calls: dict[tuple[str, str], int]


def profiled(objects: Path, seed: int, blocks: int) -> Iterator[Profile | None]:
    """A player's part: as `collecting`, and tells where the time went."""
    with collection(objects, seed, blocks) as collect:
        yield None
        while True:
            watch = Stopwatch("policy and bookkeeping")
            watch_collection(watch)
            try:
                with watch:
                    done = collect()
            finally:
                watch.unwrap()
            yield Profile(len(done), dict(watch.seconds), dict(watch.core_seconds), dict(watch.calls))


def filling_bins(objects: Path, seed: int, scenes: int) -> Iterator[tuple[int, int] | None]:
    """A player's part: `scenes` bins at a time, each filled anew and grasped in once; answers (scenes, bytes resident).

    A bin is loaded for each grasp here and for each 20 in a collection: leaks come with loading.
    """
    settings = dataclasses.replace(CollectionSettings(seed=seed), block_size=1)
    resident_bytes()
    with episode.GraspSimulation(TASK, ObjectSet.load(objects)) as simulation:
        done = 0
        yield None
        while True:
            for block in range(done, done + scenes):
                collect_block(simulation, settings, block, 1)
            done += scenes
            yield done, resident_bytes()
