"""Seconds of training until `mc` tells held-back grasps apart well enough: default settings against the paper's.

    python benchmarks/time_to_quality.py --shards data/regular-10k --work runs/time-to-quality

Every training that is over is kept in `--work`: the same command goes on with the others.
"""

import json
import statistics
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import click

from graspq.benchmarks.measuring import BenchmarkSettings, Ratio, Result, command
from graspq.benchmarks.sessions import batches_of
from graspq.common.errors import UserError
from graspq.common.options import setting
from graspq.common.text import write_jsonl
from graspq.datasets.dataset import open_shards
from graspq.datasets.pool import ShardPool
from graspq.train.loop import session
from graspq.train.settings import Preset, complete

GROWTH = 0.02


@dataclass(frozen=True, kw_only=True)
class QualitySettings(BenchmarkSettings):
    """Settings of this benchmark."""

    shards: tuple[str, ...] = setting(("data/regular-10k",), help="Dataset folders, shard files or globs.")
    threads: int | None = setting(None, help="CPU threads; torch's own choice if not given.", minimum=1)
    work: Path = setting(help="Folder for the times.")
    auc: float = setting(0.75, help="The bar: ROC AUC.", minimum=0.5, maximum=1)
    seeds: int = setting(1, help="Trainings of each; seeds from 0.", minimum=1)
    limit: float = setting(20.0, help="Times ours that the rival may take.", minimum=1)
    every: int = setting(6400, help="Transitions to a validation.", minimum=1)


@dataclass(frozen=True)
class Mark:
    """A validation: how much was trained until then, and how well it went."""

    step: int
    transitions: int
    seconds: float
    cpu_seconds: float
    auc: float


def next_validation(step: int, batch_size: int, every: int) -> int:
    """Return the step of the validation after one at `step`: `every` transitions later, or 2 % of those seen."""
    return step + max(1, round(max(every, GROWTH * step * batch_size) / batch_size))


def timed(settings: QualitySettings, pool: ShardPool, preset: Preset, seed: int, limit: float) -> list[Mark]:
    """Train until the mark is met, the limit of seconds is over, or the run is; return every validation.

    Raises:
        UserError: the held-back blocks have no success, or no failure.
    """
    path, marks, seconds, cpu_seconds = settings.work / f"{preset}-seed{seed}.jsonl", list[Mark](), 0.0, 0.0
    if path.exists():
        return [Mark(**json.loads(line)) for line in path.read_text().splitlines()]
    given = {"algo": "mc", "shards": settings.shards, "seed": seed, "device": "cpu", "threads": settings.threads}
    training, held_back = pool.split(0.05, 0)
    with tempfile.TemporaryDirectory(prefix="graspq-quality-") as folder:
        whole = complete({**given, "out": Path(folder) / "run"}, preset)
        with session(whole, pool, training, held_back) as current, batches_of(current, training) as batches:
            state = current.state
            while state.step < whole.steps and seconds < limit and not (marks and marks[-1].auc >= settings.auc):
                pause = min(next_validation(state.step, whole.batch_size, settings.every), whole.steps)
                began = time.perf_counter(), time.process_time()
                while state.step < pause and seconds + time.perf_counter() - began[0] < limit:
                    current.update(next(batches))["loss"].item()
                seconds += time.perf_counter() - began[0]
                cpu_seconds += time.process_time() - began[1]
                result = current.validate()
                if result is None or result.roc_auc_last_step is None:
                    raise UserError("the held-back blocks lack successes or failures; use more data")
                seen = state.step * whole.batch_size
                marks.append(Mark(state.step, seen, seconds, cpu_seconds, result.roc_auc_last_step))
                click.echo(f"{preset}, seed {seed}: {marks[-1]}", err=True)
    write_jsonl(path, map(asdict, marks))
    return marks


def measure(settings: QualitySettings) -> Result:
    """Return the time to quality of the default settings and of the paper's, for each seed.

    Raises:
        UserError: our own training did not meet the bar.
    """
    pool, rows, times, all_met = open_shards(settings.shards), [], [], True
    for seed in range(settings.seeds):
        ours = timed(settings, pool, "default", seed, float("inf"))[-1]
        if ours.auc < settings.auc:
            raise UserError(f"--auc: the default run ended below {settings.auc}; expected less")
        paper = timed(settings, pool, "paper", seed, settings.limit * ours.seconds)[-1]
        met = paper.auc >= settings.auc
        all_met = all_met and met
        times.append(paper.seconds / ours.seconds if met else settings.limit)
        rows += [
            {"settings": name, "seed": seed, **asdict(mark), "met": mark.auc >= settings.auc}
            for name, mark in (("default", ours), ("paper", paper))
        ]
    ratio: float | str = statistics.median(times) if all_met else f"at least {statistics.median(times):.3g}"
    says = f"seconds of training until ROC AUC {settings.auc:g}, the paper's settings against ours"
    return Result(
        [Ratio(says, ratio, bar=5, aim=15)],
        {"Time to quality of mc": rows},
    )


main = command(QualitySettings, measure)


if __name__ == "__main__":
    main()
