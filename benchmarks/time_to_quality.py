"""Seconds of training until `mc` tells held-back grasps apart well enough: default settings against the paper's.

    python benchmarks/time_to_quality.py --shards data/regular-10k --work runs/time-to-quality

Every training that is over is kept in `--work`: the same command goes on with the others.
"""

import json
import math
import statistics
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import click

from graspq.benchmarks.harness import Ratio, Result, Row, command
from graspq.benchmarks.sessions import batches_of, training_of
from graspq.common.errors import UserError
from graspq.common.options import Settings, setting
from graspq.common.text import write_jsonl
from graspq.datasets.dataset import open_shards
from graspq.train.loop import update
from graspq.train.settings import Preset

AUC = 0.75  # the bar
LIMIT = 20.0  # times ours that the rival may take
EVERY, GROWTH = 6400, 0.02  # transitions to a validation, and the share of those seen


@dataclass(frozen=True, kw_only=True)
class QualitySettings(Settings):
    """Settings of this benchmark."""

    shards: tuple[str, ...] = setting(("data/regular-10k",), help="Dataset folders, shard files or globs.")
    work: Path = setting(help="Folder for the times.")
    seeds: int = setting(1, help="Trainings of each; seeds from 0.", minimum=1)


@dataclass(frozen=True)
class Mark:
    """A validation: how much was trained until then, and how well it went."""

    step: int
    transitions: int
    seconds: float
    auc: float


def next_validation(step: int, batch_size: int) -> int:
    """Return the step of the validation after one at `step`: 6,400 transitions later, or 2 % of those seen."""
    return step + max(1, round(max(EVERY, GROWTH * step * batch_size) / batch_size))


def timed(algo: str, preset: Preset, seed: int, shards: tuple[str, ...], limit: float = math.inf) -> list[Mark]:
    """Train until the bar is met, the limit of seconds is over, or the run is; return every validation."""
    pool, marks, seconds = open_shards(shards), list[Mark](), 0.0
    with (
        training_of(algo, shards, pool, preset, seed=seed) as current,
        batches_of(current, pool.split(0.05, 0)[0]) as batches,
    ):
        state, whole = current.state, current.settings
        while state.step < whole.last_step and seconds < limit and not (marks and marks[-1].auc >= AUC):
            pause, start = min(next_validation(state.step, whole.batch_size), whole.last_step), time.perf_counter()
            while state.step < pause and seconds + time.perf_counter() - start < limit:
                update(current, next(batches))["loss"].item()
            seconds += time.perf_counter() - start
            result = current.validate()
            if result is None or result.roc_auc_last_step is None:
                raise UserError("the held-back blocks lack successes or failures; use more data")
            marks.append(Mark(state.step, state.step * whole.batch_size, seconds, result.roc_auc_last_step))
            click.echo(f"{preset}, seed {seed}: {marks[-1]}", err=True)
    return marks


def last_mark(settings: QualitySettings, preset: Preset, seed: int, limit: float = math.inf) -> Mark:
    """Return the last validation of a training of `mc`, which is done if it is not kept in `--work`."""
    path = settings.work / f"{preset}-seed{seed}.jsonl"
    if not path.exists():
        write_jsonl(path, map(asdict, timed("mc", preset, seed, settings.shards, limit)))
    return Mark(**json.loads(path.read_text().splitlines()[-1]))


def measure(settings: QualitySettings) -> Result:
    """Return the time to quality of each seed; `UserError` where our own training did not meet the bar."""
    rows: list[Row] = []
    times, all_met = [], True
    for seed in range(settings.seeds):
        ours = last_mark(settings, "default", seed)
        if ours.auc < AUC:
            raise UserError(f"the default run ended with a ROC AUC of {ours.auc:.3g}, expected {AUC}: use more data")
        paper = last_mark(settings, "paper", seed, LIMIT * ours.seconds)
        all_met = all_met and paper.auc >= AUC
        times.append(paper.seconds / ours.seconds if paper.auc >= AUC else LIMIT)
        rows += [{"settings": n, "seed": seed, **asdict(mark)} for n, mark in (("default", ours), ("paper", paper))]
    ratio = statistics.median(times)
    says = f"seconds of training until ROC AUC {AUC:g}, the paper's settings against ours"
    shown = ratio if all_met else f"at least {ratio:.3g}"
    return Result([Ratio(says, shown, bar=5, aim=15)], {"Time to quality of mc": rows})


main = command(QualitySettings, measure)


if __name__ == "__main__":
    main()
