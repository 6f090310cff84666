"""Seconds of training until `mc` tells held-back grasps apart well enough: default settings against the paper's.

    python benchmarks/time_to_quality.py --shards data/regular-10k --work runs/time-to-quality

Each training is a real session on the same blocks; "well enough" is the first validation whose ROC AUC of last steps is
at least `--auc`, with the weights that a policy would use. The clock runs while batches are waited for and trained on,
and stops for validation and checkpoints. All validate by one rule: every `--every` transitions, later whenever training
has seen 2 % more. Ours is timed inside the run that the defaults give, 3,000 steps on a cosine: whoever trains does not
know beforehand how soon a mark will be met. `--preset paper` stops at `--limit` times our time and is then shown as
"at least". What was timed is kept in `--work`, and the same command goes on where it was stopped.
"""

import json
import statistics
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import click

from graspq.benchmarks.measuring import Ratio, Result, Row, TrainingSpeedSettings
from graspq.benchmarks.sessions import batches_of
from graspq.common.errors import UserError
from graspq.common.options import Command, options_from, setting
from graspq.datasets.dataset import open_shards
from graspq.datasets.pool import ShardPool
from graspq.train.loop import Session, session
from graspq.train.settings import Preset, complete

GROWTH = 0.02


@dataclass(frozen=True, kw_only=True)
class QualitySettings(TrainingSpeedSettings):
    """Settings of this benchmark."""

    work: Path = setting(help="Folder for the runs and their times.")
    auc: float = setting(0.75, help="The bar: ROC AUC.", minimum=0.5, maximum=1)
    seeds: int = setting(1, help="Trainings of each; seeds from 0.", minimum=1)
    limit: float = setting(20.0, help="Times ours that the rival may take.", minimum=1)
    every: int = setting(6400, help="Transitions to a validation.", minimum=1)


@dataclass(frozen=True)
class Mark:
    """A validation: how much was trained until then, and how well it went."""

    step: int
    seconds: float
    cpu_seconds: float
    auc: float


class Clock:
    """Training time of a run and its validations, kept in a file beside it."""

    def __init__(self, path: Path, step: int) -> None:
        """Go on from the file at `step` of the run; later marks are dropped, for they will be made again.

        Raises:
            UserError: it has no time of that step.
        """
        self._path = path
        lines = path.read_text().split("\n")[:-1] if path.exists() else []
        self.marks = [mark for mark in (Mark(**json.loads(line)) for line in lines) if mark.step <= step]
        if step > 0 and (not self.marks or self.marks[-1].step != step):
            raise UserError(f"{path}: has no time of step {step}, where its run is; delete {path.parent}, start again")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(json.dumps(asdict(mark)) + "\n" for mark in self.marks))
        self.seconds = self.marks[-1].seconds if self.marks else 0.0
        self.cpu_seconds = self.marks[-1].cpu_seconds if self.marks else 0.0

    def start(self) -> None:
        """Let the clock run."""
        self._began = time.perf_counter(), time.process_time()

    def now(self) -> float:
        """Return the seconds so far, while the clock runs."""
        return self.seconds + time.perf_counter() - self._began[0]

    def stop(self) -> None:
        """Stop the clock."""
        self.seconds += time.perf_counter() - self._began[0]
        self.cpu_seconds += time.process_time() - self._began[1]

    def note(self, step: int, auc: float) -> Mark:
        """Keep a validation."""
        mark = Mark(step, self.seconds, self.cpu_seconds, auc)
        self.marks.append(mark)
        with self._path.open("a") as file:
            file.write(json.dumps(asdict(mark)) + "\n")
        return mark

    def reached(self, auc: float) -> Mark | None:
        """Return the first validation that was good enough."""
        return next((mark for mark in self.marks if mark.auc >= auc), None)


def next_validation(step: int, batch_size: int, every: int) -> int:
    """Return the step of the validation after one at `step`: `every` transitions later, or 2 % of those seen."""
    return step + max(1, round(max(every, GROWTH * step * batch_size) / batch_size))


def trained(
    current: Session, training: ShardPool, clock: Clock, settings: QualitySettings, limit: float
) -> Iterator[Mark]:
    """Train until the mark is met, the limit of seconds is over, or the run is; yield every validation.

    Raises:
        UserError: the held-back blocks have no success, or no failure.
    """
    state, last = current.state, current.settings.steps
    with batches_of(current, training) as batches:
        over = clock.seconds >= limit
        while clock.reached(settings.auc) is None and state.step < last and not over:
            pause = min(next_validation(state.step, current.settings.batch_size, settings.every), last)
            clock.start()
            while state.step < pause and not over:
                loss = current.update(next(batches))["loss"]
                over = clock.now() >= limit
            loss.item()
            clock.stop()
            result = current.validate()
            if result is None or result.roc_auc_last_step is None:
                raise UserError("the held-back blocks lack successes or failures; use more data")
            mark = clock.note(state.step, result.roc_auc_last_step)
            current.save()
            yield mark


def timed(settings: QualitySettings, pool: ShardPool, preset: Preset, seed: int, limit: float) -> tuple[Row, bool]:
    """Return what a training came to, and whether it met the bar before the limit of seconds."""
    training, held_back = pool.split(0.05, 0)
    folder = settings.work / f"{preset}-seed{seed}"
    given = {"algo": "mc", "shards": settings.shards, "out": folder / "run", "seed": seed, "device": "cpu"}
    whole = complete({**given, "threads": settings.threads}, preset)
    with session(whole, pool, training, held_back) as current:
        clock = Clock(folder / "clock.jsonl", current.state.step)
        for mark in trained(current, training, clock, settings, limit):
            shown = f"step {mark.step}, {mark.seconds:.1f} s, CPU {mark.cpu_seconds:.1f} s, ROC AUC {mark.auc:.3f}"
            click.echo(f"{preset}, seed {seed}: {shown}", err=True)
    found = clock.reached(settings.auc)
    last = found if found is not None else clock.marks[-1]
    row: Row = {"settings": preset, "seed": seed, "met": found is not None, **asdict(last), "seconds": clock.seconds}
    return row | {"transitions": last.step * whole.batch_size}, found is not None


def measure(settings: QualitySettings) -> Result:
    """Return the time to quality of the default settings and of the paper's, for each seed.

    Raises:
        UserError: our own training did not meet the bar.
    """
    pool, rows, times, all_met = open_shards(settings.shards), [], [], True
    for seed in range(settings.seeds):
        ours, met = timed(settings, pool, "default", seed, float("inf"))
        if not met:
            raise UserError(f"--auc: the default run ended below {settings.auc}; expected less")
        paper, met = timed(settings, pool, "paper", seed, settings.limit * ours["seconds"])
        all_met = all_met and met
        times.append(paper["seconds"] / ours["seconds"] if met else settings.limit)
        rows += [ours | {"times ours": 1.0}, paper | {"times ours": times[-1]}]
    ratio: float | str = statistics.median(times) if all_met else f"at least {statistics.median(times):.3g}"
    says = f"seconds of training until ROC AUC {settings.auc:g}, the paper's settings against ours"
    return Result(
        [Ratio(says, ratio, bar=5, aim=15)],
        {"Time to quality of mc": rows},
        {"bar, ROC AUC of last steps": settings.auc, "limit, times ours": settings.limit},
    )


@click.command(cls=Command)
@options_from(QualitySettings)
def main(settings: QualitySettings) -> None:
    """Measure the time to quality of the default settings and of the paper's."""
    measure(settings).publish(settings.out)


if __name__ == "__main__":
    main()
