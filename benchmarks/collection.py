"""Collection: grasps a second and core against the PyBullet wheel's Kuka environment, and where the time goes.

    python benchmarks/collection.py

Ours is what `grasp-datagen` runs in a worker, block by block, and the writing of their shard. The rival is
`KukaDiverseObjectEnv` (see `kuka.py`), which keeps its frames in memory. Both follow the random policy: uniform
actions, with probability 0.9 straight down. Each has a process of its own; they take turns.
"""

import contextlib
import itertools
import multiprocessing
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click
import kuka
import numpy as np
import ours
from players import Player
from tallies import Tally
from timing import median_ratio, report, take_turns

from graspq.common.options import Command
from graspq.datagen.collect import BLOCKS_PER_WORKER, Block, Collection, collected
from graspq.datagen.settings import CollectionSettings
from graspq.engine import EngineSettings, run
from graspq.objects.defaults import default_object_set
from graspq.objects.object_set import ObjectSet

OURS, RIVAL = "graspq", "KukaDiverseObjectEnv"
RENEWED_AFTER = 2  # blocks, where renewal is shown
Rows = list[dict[str, Any]]


def pace(objects: Path, seed: int, turns: int, blocks: int, rival_grasps: int) -> Rows:
    """Return a row for us and one for the rival; ratios are medians over turns."""
    with (
        Player(ours.collecting, objects, seed, blocks) as own,
        Player(kuka.collecting, seed, rival_grasps) as rival,
    ):
        players = {OURS: own, RIVAL: rival}
        seconds = take_turns({name: player.play for name, player in players.items()}, turns)
        tallies: dict[str, list[Tally]] = {name: player.results[1:] for name, player in players.items()}

    def each(name: str, what: str) -> list[float]:
        return [value / getattr(one, what) for value, one in zip(seconds[name], tallies[name], strict=True)]

    rows = []
    for name, made in tallies.items():
        row: dict[str, Any] = {"environment": name}
        for what in ("grasps", "actions", "frames"):
            row[f"{what} a second"] = 1 / statistics.median(each(name, what))
            row[f"times ({what})"] = median_ratio(each(RIVAL, what), each(name, what))
        grasps = sum(one.grasps for one in made)
        row["CPU ms a grasp"] = 1e3 * sum(one.core_seconds for one in made) / grasps
        row["actions a grasp"] = sum(one.actions for one in made) / grasps
        row["success"] = sum(one.successes for one in made) / grasps
        row["grasps"] = grasps
        rows.append(row)
    return rows


def profile(objects: Path, seed: int, turns: int, blocks: int) -> Rows:
    """Return milliseconds a grasp of every phase and of what in it, the longest first; medians over turns."""
    with Player(ours.profiled, objects, seed, blocks) as player:
        for _ in range(turns + 1):
            player.play()
    results: list[ours.Profile] = player.results[1:]

    def middle(values: Callable[[ours.Profile], float]) -> float:
        return statistics.median(values(result) / result.grasps for result in results)

    def row(phase: str, what: str) -> dict[str, Any]:
        place = (phase, what)
        return {
            "phase": phase,
            "what": what,
            "ms a grasp": middle(lambda result: 1e3 * result.seconds.get(place, 0.0)),
            "CPU ms a grasp": middle(lambda result: 1e3 * result.core_seconds.get(place, 0.0)),
            "calls a grasp": middle(lambda result: result.calls.get(place, 0)),
        }

    rows = [row(*place) for place in sorted({place for result in results for place in result.seconds})]
    rows.sort(key=lambda row: -row["CPU ms a grasp"])
    whole = {
        "phase": "all",
        "what": "",
        "ms a grasp": middle(lambda result: 1e3 * sum(result.seconds.values())),
        "CPU ms a grasp": middle(lambda result: 1e3 * sum(result.core_seconds.values())),
        "calls a grasp": "",
    }
    return [*rows, whole]


def pool_seconds(objects: Path, seed: int, team: int, blocks: int) -> float:
    """Return seconds a grasp of a running pool of `team` workers, a shard of all blocks written.

    The clock runs from the first block that each worker has done on average until `blocks` more of each are done: a
    long collection's pace, without the start of processes.
    """
    settings = CollectionSettings(seed=seed)
    # More blocks than are waited for: no worker is idle before the clock stops.
    size = settings.block_size
    units = [Block(number, size, number * size) for number in range(team * (blocks + 3))]
    with tempfile.TemporaryDirectory() as folder:
        shards = ours.Shards(folder, objects, settings)
        work = Collection(ours.TASK.settings.to_json(), objects, settings)
        with contextlib.closing(collected(work, units, EngineSettings(workers=team))) as finished:
            for _ in itertools.islice(finished, team):
                pass
            start = time.perf_counter()
            done = [episodes for _, episodes in itertools.islice(finished, team * blocks)]
            for episodes in done:
                shards.add(episodes)
            seconds = time.perf_counter() - start
    return seconds / sum(map(len, done))


def scaling(objects: Path, seed: int, turns: int, blocks: int, teams: Sequence[int]) -> Rows:
    """Return a row for each size of the pool of workers."""
    seconds: dict[int, list[float]] = {team: [] for team in teams}
    for turn in range(turns):
        for team in teams:
            seconds[team].append(pool_seconds(objects, seed + turn, team, blocks))
    first = teams[0]
    return [
        {
            "workers": team,
            "grasps a second": 1 / statistics.median(values),
            f"times {first} worker": median_ratio(seconds[first], values),
        }
        for team, values in seconds.items()
    ]


def memory(objects: Path, seed: int, scenes: int) -> tuple[Rows, dict[str, Any]]:
    """Return a worker's resident memory over `scenes` bins, and what follows for a worker's life."""
    with Player(ours.filling_bins, objects, seed, max(1, scenes // 20)) as player:
        while not player.results or player.results[-1][0] < scenes:
            player.play()
    counts, sizes = np.array(player.results, dtype=float).T
    later = slice(len(counts) // 2, None)
    slope = float(np.polyfit(counts[later], sizes[later], 1)[0]) if len(counts[later]) > 1 else float("nan")
    rows = [{"bins filled": int(counts[index]), "resident MB": sizes[index] / 1e6} for index in _spread(len(counts))]
    return rows, {
        "growth, kB a bin (second half)": slope / 1e3,
        "bins in a worker's life": BLOCKS_PER_WORKER,
        "growth in a worker's life, MB": slope * BLOCKS_PER_WORKER / 1e6,
        f"processes for 6 blocks with 1 worker renewed after {RENEWED_AFTER}": processes_seen(objects, seed, blocks=6),
    }


def _spread(count: int) -> list[int]:
    return sorted({round(place) for place in np.linspace(0, count - 1, min(count, 5))})


def processes_seen(objects: Path, seed: int, blocks: int) -> int:
    """Return how many processes a pool of one worker used, whose workers are renewed after `RENEWED_AFTER` blocks."""
    work = Collection(ours.TASK.settings.to_json(), objects, CollectionSettings(seed=seed))
    units = [Block(number, 1, number) for number in range(blocks)]
    seen: set[int | None] = set()
    for _ in run(work, units, EngineSettings(workers=1), units_per_worker=RENEWED_AFTER):
        seen |= {process.pid for process in multiprocessing.active_children()}
    return len(seen)


PARTS = ("pace", "profile", "scaling", "memory")


@click.command(cls=Command)
@click.option("--part", "parts", type=click.Choice(PARTS), multiple=True, help="What to measure; all if not given.")
@click.option(
    "--objects",
    type=click.Path(path_type=Path),
    default=None,
    help="Folder of the object set; the project's own if not given.",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of scenes and actions.")
@click.option("--turns", type=click.IntRange(1), default=7, show_default=True, help="Turns that are measured.")
@click.option("--blocks", type=click.IntRange(1), default=3, show_default=True, help="Blocks of 20 grasps in a turn.")
@click.option("--rival-grasps", type=click.IntRange(1), default=5, show_default=True, help="The rival's, in a turn.")
@click.option("--workers", type=click.IntRange(2), default=2, show_default=True, help="Workers, against 1.")
@click.option("--scenes", type=click.IntRange(2), default=500, show_default=True, help="Bins to fill for the memory.")
@click.option("--out", type=click.Path(path_type=Path), default=None, help="JSON file for the figures.")
def main(
    parts: tuple[str, ...],
    objects: Path | None,
    seed: int,
    turns: int,
    blocks: int,
    rival_grasps: int,
    workers: int,
    scenes: int,
    out: Path | None,
) -> None:
    """Measure collection: pace against the rival, profile of a grasp, scaling over workers, memory of a worker."""
    folder = (ObjectSet.load(objects) if objects is not None else default_object_set("regular")).folder
    chosen = [part for part in PARTS if part in parts or not parts]
    tables: dict[str, Rows] = {}
    facts: dict[str, Any] = {"turns": turns, "grasps a turn": blocks * CollectionSettings().block_size}
    if "pace" in chosen:
        tables["Collection, one process each"] = pace(folder, seed, turns, blocks, rival_grasps)
        facts["the rival's grasps a turn"] = rival_grasps
    if "profile" in chosen:
        tables["Where a grasp's time goes"] = profile(folder, seed, turns, blocks)
    if "scaling" in chosen:
        tables["Scaling over workers"] = scaling(folder, seed, turns, 2 * blocks, (1, workers))
    if "memory" in chosen:
        tables["Memory of a worker"], more = memory(folder, seed, scenes)
        facts |= more
    (title, rows), *others = tables.items()
    report(title, rows, {**dict(others), **facts}, out)


if __name__ == "__main__":
    main()
