"""Collection: grasps a second and core against the PyBullet wheel's Kuka environment, and where the time goes.

python benchmarks/collection.py
"""

import contextlib
import itertools
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from graspq.benchmarks.harness import Ratio, Result, Row, TurnsSettings, alone, command, median_ratio, take_turns
from graspq.benchmarks.kuka import Tally, kuka_grasps
from graspq.benchmarks.stopwatch import PYTHON, Stopwatch
from graspq.common.options import setting
from graspq.datagen.collect import Block, Collection, collected
from graspq.datagen.making import describe
from graspq.datagen.settings import CollectionSettings, DatagenSettings
from graspq.datasets import writer
from graspq.datasets.episode import Episode
from graspq.engine import EngineSettings
from graspq.objects.defaults import default_object_set
from graspq.objects.object_set import ObjectSet
from graspq.sim import cell, episode, kinematics, rasteriser
from graspq.sim.bullet import bullet
from graspq.sim.task import task_named

TASK = task_named("regular")
OURS, RIVAL = "graspq", "KukaDiverseObjectEnv"
RIVAL_GRASPS = 5
BLOCK = CollectionSettings().block_size
HERE = EngineSettings(workers=0)


@dataclass(frozen=True)
class CollectionBenchmarkSettings(TurnsSettings):
    """Settings of this benchmark."""

    turns: int = setting(7, help="Turns that are measured.", minimum=1)
    blocks: int = setting(3, help="Blocks of 20 grasps in a turn; of each worker twice as many.", minimum=1)
    engines: tuple[Literal["local", "ray"], ...] = setting(("local", "ray"), help="Engines of two workers.")


@contextlib.contextmanager
def collection(objects: Path, seed: int, engine: EngineSettings) -> Iterator[Callable[[int], list[Episode]]]:
    """Give what collects so many further blocks for each worker as `grasp-datagen` does, and writes their shards."""
    manifest = describe(DatagenSettings(seed=seed), TASK, ObjectSet.load(objects))
    work = Collection(TASK.settings.to_json(), objects, CollectionSettings(seed=seed))
    # Without end: no worker is idle before the clock stops.
    results = collected(work, (Block(number, BLOCK, number * BLOCK) for number in itertools.count()), engine)

    def write(folder: Path, episodes: Sequence[Episode]) -> None:
        nonlocal manifest
        first, last = episodes[0].block, episodes[-1].block
        entry = writer.write_shard(folder, manifest, first, last - first + 1, episodes)
        manifest = writer.commit_shard(folder, manifest, entry)

    with tempfile.TemporaryDirectory(prefix="graspq-collection-") as name, contextlib.closing(results):
        manifest.save(Path(name))

        def collect(blocks: int) -> list[Episode]:
            done = [episodes for _, episodes in itertools.islice(results, blocks * max(engine.workers or 0, 1))]
            together = list(itertools.chain.from_iterable(done))
            for shard in [together] if engine == HERE else done:  # blocks of several workers come in any order
                write(Path(name), shard)
            return together

        yield collect


def our_grasps(objects: Path, seed: int, engine: EngineSettings, blocks: int) -> Tally:
    """Return what blocks of each worker came to, after a first one, which is not counted: no start of processes."""
    started = time.perf_counter()
    with collection(objects, seed, engine) as collect:
        collect(1)
        start = time.perf_counter()
        done = collect(blocks)
        seconds = time.perf_counter() - start
    actions = sum(one.steps for one in done)
    # The frame after the lift is not rendered in a collection.
    return Tally(seconds, len(done), actions, actions, start - started)


def watched(watch: Stopwatch) -> Stopwatch:
    """Put a stopwatch around the phases of a grasp, and around the calls into native code and the kinematics."""
    for owner, name, phase in (
        (episode.GraspSimulation, "load", "loading the bin"),
        (cell, "drop", "settling"),
        (cell, "settle", "settling"),
        (episode.GraspSimulation, "step", "moving"),
        (episode.GraspSimulation, "_close_and_lift", "grasping and lifting"),
        (episode.GraspSimulation, "render", "rendering"),
        (writer, "write_shard", "writing"),
        (writer, "commit_shard", "writing"),
    ):
        watch.wrap(owner, name, phase=phase)
    for name in ("stepSimulation", "getLinkStates", "loadURDF", "resetSimulation"):
        watch.wrap(bullet, name, what="PyBullet")
    for name in ("project", "fill", "colour", "shade"):
        watch.wrap(rasteriser, name, what="rasteriser")
    watch.wrap(bullet, "setJointMotorControlArray", what="IK and motors")
    watch.wrap(kinematics, "joint_angles", what="IK and motors")
    return watch


def phases(objects: Path, seed: int, blocks: int) -> list[Row]:
    """Return CPU milliseconds of every phase of a grasp, the longest first."""
    with collection(objects, seed, HERE) as collect:
        collect(1)
        with watched(Stopwatch("policy and bookkeeping")) as watch:
            grasps = len(collect(blocks))
    spent = {place: 1e3 * seconds / grasps for place, seconds in watch.seconds.items()}
    rows = []
    for phase in {phase for phase, _ in spent}:
        kinds = {kind: spent.get((phase, kind), 0.0) for kind in ("PyBullet", "IK and motors", "rasteriser", PYTHON)}
        total = sum(kinds.values())
        share = f"{total / sum(spent.values()):.0%}"
        rows.append({"phase of a grasp": phase, "CPU ms": total, "share": share, **kinds})
    return sorted(rows, key=lambda row: -float(row["CPU ms"]))


def measure(settings: CollectionBenchmarkSettings) -> Result:
    """Return pace against the rival, pace of several workers, and the phases of a grasp."""
    objects, blocks = default_object_set("regular").folder, settings.blocks
    arms: dict[str, Callable[[int], Tally]] = {
        OURS: lambda turn: alone(our_grasps, objects, turn, HERE, blocks),
        RIVAL: lambda turn: alone(kuka_grasps, turn, RIVAL_GRASPS),
    }
    for engine, workers in itertools.product(settings.engines, (1, 2)):
        given = EngineSettings(engine=engine, workers=workers)
        arms[f"{engine}, {workers}"] = partial(our_grasps, objects, engine=given, blocks=2 * blocks)
    tallies = take_turns(arms, settings.turns, warm_up=False)

    def each(name: str, what: str) -> list[float]:
        return [tally.seconds / getattr(tally, what) for tally in tallies[name]]

    def times(what: str) -> float:
        return median_ratio(each(RIVAL, what), each(OURS, what))

    def scaling(engine: str, says: str) -> Ratio:
        faster = median_ratio(each(f"{engine}, 1", "grasps"), each(f"{engine}, 2", "grasps"))
        return Ratio(f"collection, 2 workers against 1{says}", faster, bar=1.8, aim=1.95)

    pace = [
        {"collection; engine and workers": name}
        | {f"{what} a second": 1 / statistics.median(each(name, what)) for what in ("grasps", "actions", "frames")}
        | {"seconds before the clock": statistics.median(tally.begun for tally in found)}
        for name, found in tallies.items()
    ]
    says = "grasps collected a second and core, against the wheel's `KukaDiverseObjectEnv`"
    return Result(
        [
            Ratio(says, times("grasps"), bar=25, aim=50),
            Ratio("… a simulated action (a grasp of ours has fewer of them)", times("actions")),
            Ratio("… a rendered frame", times("frames")),
            *(scaling(engine, ", on Ray" if engine == "ray" else "") for engine in settings.engines),
        ],
        {
            "Pace of collection": pace,
            "Where a grasp's time goes": alone(phases, objects, 0, blocks * settings.turns),
        },
    )


main = command(CollectionBenchmarkSettings, measure)


if __name__ == "__main__":
    main()
