"""Training speed of every estimator against `mc`: real transitions a second, padding not counted.

    python benchmarks/estimators.py --shards data/regular-10k

All take turns in one process, on batches of the same data that lie ready in memory: what is timed is augmentation,
targets, forward, backward and optimiser, as `grasp-train` runs them with default options.
"""

import contextlib
import itertools
import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path

import click
from timing import median_ratio, report, take_turns

from graspq.datasets.dataset import open_shards
from graspq.datasets.pool import ShardPool
from graspq.train.batch import Batch
from graspq.train.batches import training_batches
from graspq.train.estimators import ESTIMATORS
from graspq.train.loop import Session, session
from graspq.train.settings import preset_settings

RIVAL = "mc"


def ready(current: Session, pool: ShardPool, count: int) -> list[Batch]:
    """Return the first batches of a run."""
    with training_batches(pool, current.settings, current.estimator, current.precision.device, 0) as batches:
        return list(itertools.islice(batches, count))


def training(current: Session, batches: list[Batch]) -> Callable[[], None]:
    """Return what trains one step on each batch and waits until it is done."""

    def run() -> None:
        for batch in batches:
            loss = current.update(batch)
        loss.item()

    return run


@click.command()
@click.option("--shards", multiple=True, required=True, help="Dataset folders, shard files or globs.")
@click.option("--turns", type=click.IntRange(1), default=5, show_default=True, help="Turns that are measured.")
@click.option("--steps", type=click.IntRange(1), default=6, show_default=True, help="Steps of each in a turn.")
@click.option("--threads", type=click.IntRange(1), default=None, help="CPU threads; torch's own choice if not given.")
@click.option("--out", type=click.Path(path_type=Path), default=None, help="JSON file for the figures.")
def main(shards: tuple[str, ...], turns: int, steps: int, threads: int | None, out: Path | None) -> None:
    """Measure all estimators of the table."""
    pool = open_shards(shards)
    kept, held_back = pool.split(0.05, 0)
    runs, real = {}, {}
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        for name in ESTIMATORS:
            # Without its rest: ddpg's actor is at work in most of a training.
            settings = preset_settings(
                "default",
                algo=name,
                shards=shards,
                out=Path(folder) / name,
                threads=threads,
                device="cpu",
                actor_rest=0.0,
            )
            current = stack.enter_context(session(settings, pool, kept, held_back))
            batches = ready(current, kept, steps)
            runs[name], real[name] = training(current, batches), sum(int(batch.real_steps) for batch in batches)
        seconds = take_turns(runs, turns)
    pace = {name: [value / real[name] for value in values] for name, values in seconds.items()}
    rows = [
        {
            "estimator": name,
            "transitions a second": 1 / statistics.median(values),
            f"times {RIVAL}": median_ratio(pace[RIVAL], values),
        }
        for name, values in pace.items()
    ]
    report("Training speed of the estimators", rows, {"steps a turn": steps, "turns": turns}, out)


if __name__ == "__main__":
    main()
