"""Training speed of every estimator against `mc`: real transitions a second, padding not counted.

    python benchmarks/estimators.py --shards data/regular-10k

All take turns in one process, on batches of the same data that lie ready in memory: what is timed is augmentation,
targets, forward, backward and optimiser, as `grasp-train` runs them with default options.
"""

import contextlib
import statistics
import tempfile
from pathlib import Path

import click
from sessions import default_settings, ready, steps_on
from timing import median_ratio, report, take_turns

from graspq.common.options import Command
from graspq.datasets.dataset import open_shards
from graspq.train.estimators import ESTIMATORS
from graspq.train.loop import session

RIVAL = "mc"


@click.command(cls=Command)
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
            settings = default_settings(name, shards, Path(folder) / name, threads)
            current = stack.enter_context(session(settings, pool, kept, held_back))
            batches = ready(current, kept, steps)
            runs[name], real[name] = steps_on(batches, current.update), sum(int(batch.real_steps) for batch in batches)
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
