"""Collection: grasps a second and core against the PyBullet wheel's Kuka environment, and where the time goes.

python benchmarks/collection.py
"""

import contextlib
import itertools
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from graspq.benchmarks.kuka import Tally, kuka_grasps
from graspq.benchmarks.measuring import Call, Ratio, Result, Row, TurnsSettings, apart, command, median_ratio
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
from graspq.sim import camera, cell, episode, kinematics
from graspq.sim.bullet import bullet
from graspq.sim.task import task_named

TASK = task_named("regular")
Engine = Literal["local", "ray"]
_ON = {"local": "", "ray": ", on Ray"}
OURS, RIVAL = "graspq", "KukaDiverseObjectEnv"
BLOCK = CollectionSettings().block_size


@dataclass(frozen=True)
class CollectionBenchmarkSettings(TurnsSettings):
    """Settings of this benchmark."""

    turns: int = setting(7, help="Turns that are measured.", minimum=1)
    seed: int = setting(0, help="Seed of scenes and actions.", minimum=0)
    blocks: int = setting(3, help="Blocks of 20 grasps in a turn.", minimum=1)
    rival_grasps: int = setting(5, help="The rival's grasps in a turn.", minimum=1)
    workers: int = setting(2, help="Workers, against 1.", minimum=2)
    engines: tuple[Engine, ...] = setting(("local", "ray"), help="Engines that they work in: local, ray.")


@contextlib.contextmanager
def shards_of(objects: Path, seed: int) -> Iterator[Callable[[Sequence[Episode]], None]]:
    """Give what writes the episodes of consecutive blocks as a shard of a temporary dataset."""
    with tempfile.TemporaryDirectory(prefix="graspq-collection-") as folder:
        manifest = describe(DatagenSettings(seed=seed), TASK, ObjectSet.load(objects))
        manifest.save(Path(folder))

        def add(episodes: Sequence[Episode]) -> None:
            nonlocal manifest
            first, last = episodes[0].block, episodes[-1].block
            entry = writer.write_shard(Path(folder), manifest, first, last - first + 1, episodes)
            manifest = writer.commit_shard(Path(folder), manifest, entry)

        yield add


def work(objects: Path, seed: int) -> Collection:
    """Return what `grasp-datagen` hands to the engine."""
    return Collection(TASK.settings.to_json(), objects, CollectionSettings(seed=seed))


def whole_blocks(numbers: Iterable[int]) -> list[Block]:
    """Return blocks of 20 grasps."""
    return [Block(number, BLOCK, number * BLOCK) for number in numbers]


@contextlib.contextmanager
def collection(objects: Path, seed: int) -> Iterator[Callable[[range], list[Episode]]]:
    """Give what collects whole blocks in this process and writes their shard."""
    with shards_of(objects, seed) as add, work(objects, seed).open(lambda folder: folder) as collect:

        def blocks(numbers: range) -> list[Episode]:
            done = [one for block in whole_blocks(numbers) for one in collect(block)]
            add(done)
            return done

        yield blocks


def our_grasps(objects: Path, seed: int, blocks: range) -> Tally:
    """Return what some blocks came to, their shard written, after the first, which is not counted."""
    with collection(objects, seed) as collect:
        collect(blocks[:1])
        start, core_start = time.perf_counter(), time.process_time()
        done = collect(blocks[1:])
        seconds, core_seconds = time.perf_counter() - start, time.process_time() - core_start
    actions = sum(one.steps for one in done)
    # The frame after the lift is not rendered in a collection.
    return Tally(seconds, core_seconds, len(done), actions, actions, sum(bool(one.success) for one in done))


def paces(objects: Path, settings: CollectionBenchmarkSettings) -> list[Row]:
    """Return a row for us and one for the rival; ratios are medians over turns."""
    seed, length = settings.seed, settings.blocks + 1
    calls: list[Call] = []
    for turn in range(settings.turns):
        pair = [
            Call(our_grasps, (objects, seed, range(turn * length, (turn + 1) * length))),
            Call(kuka_grasps, (seed + turn, settings.rival_grasps)),
        ]
        calls += pair if turn % 2 == 0 else pair[::-1]
    results = list(zip(calls, apart(calls), strict=True))
    ours, theirs = ([found for call, found in results if call.function is one] for one in (our_grasps, kuka_grasps))

    def each(tallies: Sequence[Tally], what: str) -> list[float]:
        return [tally.seconds / getattr(tally, what) for tally in tallies]

    rows: list[Row] = []
    for name, tallies in ((OURS, ours), (RIVAL, theirs)):
        row: Row = {"environment": name}
        for what in ("grasps", "actions", "frames"):
            row[f"{what} a second"] = 1 / statistics.median(each(tallies, what))
            row[f"times ({what})"] = median_ratio(each(theirs, what), each(tallies, what))
        grasps = sum(tally.grasps for tally in tallies)
        row["CPU ms a grasp"] = 1e3 * sum(tally.core_seconds for tally in tallies) / grasps
        row["actions a grasp"] = sum(tally.actions for tally in tallies) / grasps
        row["success"] = sum(tally.successes for tally in tallies) / grasps
        rows.append(row | {"grasps": grasps})
    return rows


def watched(watch: Stopwatch) -> Stopwatch:
    """Put a stopwatch around the phases of a grasp, and around the calls into native code and the kinematics."""
    for owner, name, phase in (
        (episode.GraspSimulation, "load", "loading the bin"),
        (cell, "drop", "settling"),
        (cell, "settle", "settling"),
        (episode.GraspSimulation, "step", "moving"),
        (episode.GraspSimulation, "_close_and_lift", "grasping and lifting"),
        (camera.Camera, "render", "rendering"),
        (writer, "write_shard", "writing"),
        (writer, "commit_shard", "writing"),
    ):
        watch.as_phase(owner, name, phase)
    for name in ("stepSimulation", "getCameraImage", "loadURDF", "resetSimulation"):
        watch.as_part(bullet, name, "PyBullet")
    watch.as_part(bullet, "setJointMotorControlArray", "IK and motors")
    watch.as_part(kinematics, "joint_angles", "IK and motors")
    return watch


def phases(objects: Path, seed: int, blocks: int) -> list[Row]:
    """Return CPU milliseconds of every phase of a grasp, the longest first."""
    with collection(objects, seed) as collect:
        collect(range(1))
        with watched(Stopwatch("policy and bookkeeping")) as watch:
            grasps = len(collect(range(1, blocks + 1)))
    spent = {place: 1e3 * seconds / grasps for place, seconds in watch.seconds.items()}
    whole = sum(spent.values())
    rows = []
    for phase in {phase for phase, _ in spent}:
        kinds = {kind: spent.get((phase, kind), 0.0) for kind in ("PyBullet", "IK and motors", PYTHON)}
        total = sum(kinds.values())
        rows.append({"phase of a grasp": phase, "CPU ms": total, "share": f"{total / whole:.0%}", **kinds})
    return sorted(rows, key=lambda row: -float(row["CPU ms"]))


@dataclass(frozen=True)
class Pace:
    """Seconds until the first block of a collection is there, and seconds a grasp later on."""

    first_block: float
    grasp: float


def pace_of(objects: Path, seed: int, engine: EngineSettings, blocks: int) -> Pace:
    """Return the pace of an engine's workers, a shard of all blocks written.

    The clock of the pace runs from the first block that each worker has done on average until `blocks` more of each are
    done: a long collection's pace, without the start of processes.
    """
    workers = engine.workers or 1
    # More blocks than are waited for: no worker is idle before the clock stops.
    results = collected(work(objects, seed), whole_blocks(range(workers * (blocks + 3))), engine)
    with shards_of(objects, seed) as add, contextlib.closing(results):
        start = time.perf_counter()
        next(results)
        first = time.perf_counter() - start
        for _ in itertools.islice(results, workers - 1):
            pass
        start = time.perf_counter()
        done = [episodes for _, episodes in itertools.islice(results, workers * blocks)]
        for episodes in done:
            add(episodes)
        return Pace(first, (time.perf_counter() - start) / (len(done) * BLOCK))


def measure(settings: CollectionBenchmarkSettings) -> Result:
    """Return pace against the rival, pace of several workers, and the phases of a grasp."""
    objects = default_object_set("regular").folder
    pace = paces(objects, settings)
    counts = (1, settings.workers)
    teams = [EngineSettings(engine=engine, workers=count) for engine in settings.engines for count in counts]
    seen: dict[EngineSettings, list[Pace]] = {team: [] for team in teams}
    for turn, team in itertools.product(range(settings.turns), teams):
        seen[team].append(pace_of(objects, settings.seed + turn, team, 2 * settings.blocks))
    seconds = {team: [pace.grasp for pace in paces] for team, paces in seen.items()}
    times = {team: median_ratio(seconds[replace(team, workers=1)], values) for team, values in seconds.items()}
    scaling = [
        {
            "engine": team.engine,
            "workers": team.workers,
            "seconds to the first block": statistics.median(pace.first_block for pace in seen[team]),
            "grasps a second": 1 / statistics.median(seconds[team]),
            "times 1 worker": times[team],
        }
        for team in teams
    ]
    (profile,) = apart([Call(phases, (objects, settings.seed, settings.blocks * settings.turns))])
    ours = pace[0]
    says = "grasps collected a second and core, against the wheel's `KukaDiverseObjectEnv`"
    return Result(
        [
            Ratio(says, ours["times (grasps)"], bar=25, aim=50),
            Ratio("… a simulated action (a grasp of ours has fewer of them)", ours["times (actions)"]),
            Ratio("… a rendered frame", ours["times (frames)"]),
            *(
                Ratio(f"collection, {team.workers} workers against 1{_ON[team.engine]}", times[team], bar=1.8, aim=1.95)
                for team in teams
                if team.workers != 1
            ),
        ],
        {
            "Collection, one process each": pace,
            "Scaling over workers": scaling,
            "Where a grasp's time goes": profile,
        },
    )


main = command(CollectionBenchmarkSettings, measure)


if __name__ == "__main__":
    main()
