"""Seconds of training until `mc` tells held-back grasps apart well enough: default settings against the paper's.

    python benchmarks/time_to_quality.py --shards data/regular-10k --work runs/time-to-quality

Each training is a real session on the same blocks; "well enough" is the first validation whose ROC AUC of last steps is
at least `--auc`, with the weights that a policy would use. The clock runs while batches are waited for and trained on,
and stops for validation and checkpoints; opening a session, with our probe of the precision, is not in it. All validate
by one rule: every `--every` transitions, later whenever training has seen 2 % more. `--preset paper` is the paper's
network, batch of 32, squared error, Adam at a constant rate, no augmentation, float32; of the rates and widths that
the paper sweeps it takes the middle rate and the smaller, faster width. It stops at `--limit` times our time and is
then shown as "> 20".

Our rate follows a cosine over the steps of the run, so its time to a mark depends on how long the run was meant to be.
The headline is the time inside the run that the defaults give, 3,000 steps: whoever trains does not know beforehand how
soon a mark will be met. Where `--short-steps` is given, a run of so few steps is timed too: what one could have had,
knowing the answer. The defaults were chosen by success on grasps of a dataset of this size, not by this mark.

Trainings run one after the other. CPU seconds stand beside the seconds: they hardly depend on what else the machine
does. What was timed is kept in `--work`, and the same command goes on where it was stopped.
"""

import json
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
from timing import report

from graspq.common.errors import UserError
from graspq.common.options import Command
from graspq.datasets.dataset import open_shards
from graspq.datasets.pool import ShardPool
from graspq.train.batches import training_batches
from graspq.train.loop import Session, session
from graspq.train.settings import PRESETS, TrainSettings, preset_settings

OURS, SHORT, PAPER = "default", "default, short schedule", "paper"
GROWTH = 0.02


@dataclass(frozen=True)
class Mark:
    """A validation: how much was trained until then, and how well it went."""

    step: int
    seconds: float
    cpu_seconds: float
    auc: float


class Clock:
    """Training time of a run and its validations, kept in a file beside it.

    Args:
        path: the file, one JSON object a line.
        step: of the run as it is now; later marks are dropped, for they will be made again.
    """

    def __init__(self, path: Path, step: int) -> None:
        self._path = path
        lines = path.read_text().split("\n")[:-1] if path.exists() else []
        self.marks = [mark for mark in (Mark(**json.loads(line)) for line in lines) if mark.step <= step]
        if step > 0 and (not self.marks or self.marks[-1].step != step):
            raise UserError(
                f"{path}: has no time of step {step}, where its run is; delete {path.parent} and start again"
            )
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(json.dumps(vars(mark)) + "\n" for mark in self.marks))
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
            file.write(json.dumps(vars(mark)) + "\n")
        return mark


def next_validation(step: int, batch_size: int, every: int) -> int:
    """Return the step of the validation after one at `step`: `every` transitions later, or 2 % of those seen."""
    return step + max(1, round(max(every, GROWTH * step * batch_size) / batch_size))


def first_reached(marks: list[Mark], auc: float) -> Mark | None:
    """Return the first validation that was good enough."""
    return next((mark for mark in marks if mark.auc >= auc), None)


def trained(
    current: Session, training: ShardPool, clock: Clock, every: int, auc: float, limit: float | None
) -> Iterator[Mark]:
    """Train until the mark is met, the limit of seconds is over, or the run is; yield every validation.

    Raises:
        UserError: the held-back blocks have no success, or no failure.
    """
    settings, state = current.settings, current.state
    source = training_batches(
        training.with_discount(current.discount), settings, current.estimator, current.precision.device, state.step
    )
    with source as batches:
        over = limit is not None and clock.seconds >= limit
        while first_reached(clock.marks, auc) is None and state.step < settings.steps and not over:
            pause = min(next_validation(state.step, settings.batch_size, every), settings.steps)
            clock.start()
            while state.step < pause and not over:
                loss = current.update(next(batches))
                over = limit is not None and clock.now() >= limit
            loss.item()
            clock.stop()
            result = current.validate()
            if result is None or result.roc_auc_last_step is None:
                raise UserError("the held-back blocks lack successes or failures; use more data")
            mark = clock.note(state.step, result.roc_auc_last_step)
            current.save()
            yield mark


def run_settings(kind: str, shards: tuple[str, ...], folder: Path, seed: int, options: "Options") -> TrainSettings:
    """Return the settings of one training."""
    preset = "paper" if kind == PAPER else "default"
    settings = preset_settings(
        preset, algo="mc", shards=shards, out=folder / "run", seed=seed, threads=options.threads, device="cpu"
    )
    # All held-back data, and the newest checkpoint alone.
    settings = replace(settings, validation_transitions=10**9, keep_checkpoints=1)
    return settings if kind != SHORT else replace(settings, steps=options.short_steps)


@dataclass(frozen=True)
class Options:
    """What applies to all trainings of a call."""

    shards: tuple[str, ...]
    work: Path
    auc: float
    every: int
    limit: float
    short_steps: int
    threads: int | None


def measured(options: Options, pool: ShardPool, kind: str, seed: int, limit: float | None) -> Mark | float:
    """Return the mark where a training met the bar, or the seconds after which it had not."""
    training, held_back = pool.split(0.05, 0)
    folder = options.work / f"{kind.replace(', ', '-').replace(' ', '-')}-seed{seed}"
    settings = run_settings(kind, options.shards, folder, seed, options)
    with session(settings, pool, training, held_back) as current:
        clock = Clock(folder / "clock.jsonl", current.state.step)
        for mark in trained(current, training, clock, options.every, options.auc, limit):
            shown = f"step {mark.step}, {mark.seconds:.1f} s, CPU {mark.cpu_seconds:.1f} s, ROC AUC {mark.auc:.3f}"
            click.echo(f"{kind}, seed {seed}: {shown}", err=True)
    found = first_reached(clock.marks, options.auc)
    return clock.seconds if found is None else found


def row_of(kind: str, seed: int, batch_size: int, result: Mark | float, ours: Mark | None) -> dict[str, Any]:
    """Return a row of the table; what was not met is shown as more than the time that was given."""
    row: dict[str, Any] = {"settings": kind, "seed": seed}
    if not isinstance(result, Mark):
        ratio = f"> {result / ours.seconds:.3g}" if ours is not None else None
        none = {"CPU seconds": None, "steps": None, "transitions": None, "ROC AUC": None}
        return row | {"seconds": f"> {result:.3g}", **none, "times ours": ratio, "times ours, CPU seconds": None}
    return row | {
        "seconds": result.seconds,
        "CPU seconds": result.cpu_seconds,
        "steps": result.step,
        "transitions": result.step * batch_size,
        "ROC AUC": result.auc,
        "times ours": result.seconds / ours.seconds if ours is not None else None,
        "times ours, CPU seconds": result.cpu_seconds / ours.cpu_seconds if ours is not None else None,
    }


def rows_of(options: Options, pool: ShardPool, seeds: int, rival: bool) -> Iterator[dict[str, Any]]:
    """Yield the rows: for each seed ours, the short run where one was asked for, and the paper's.

    Raises:
        UserError: our own training did not meet the bar.
    """
    ours_size = PRESETS["default"]["batch_size"]
    for seed in range(seeds):
        ours = measured(options, pool, OURS, seed, None)
        if not isinstance(ours, Mark):
            raise UserError(f"--auc: the default run ended after {ours:.0f} s below {options.auc}; expected less")
        yield row_of(OURS, seed, ours_size, ours, ours)
        if options.short_steps:
            yield row_of(SHORT, seed, ours_size, measured(options, pool, SHORT, seed, None), ours)
        if rival:
            yield row_of(
                PAPER,
                seed,
                PRESETS["paper"]["batch_size"],
                measured(options, pool, PAPER, seed, options.limit * ours.seconds),
                ours,
            )


@click.command(cls=Command)
@click.option("--shards", multiple=True, required=True, help="Dataset folders, shard files or globs.")
@click.option("--work", type=click.Path(path_type=Path), required=True, help="Folder for the runs and their times.")
@click.option("--auc", type=click.FloatRange(0.5, 1), default=0.75, show_default=True, help="The bar: ROC AUC.")
@click.option("--seeds", type=click.IntRange(1), default=1, show_default=True, help="Trainings of each; seeds from 0.")
@click.option("--limit", type=click.FloatRange(1), default=20, show_default=True, help="Times ours the rival may take.")
@click.option("--every", type=click.IntRange(1), default=6400, show_default=True, help="Transitions to a validation.")
@click.option("--short-steps", type=click.IntRange(0), default=0, help="Steps of a short run of ours.  [default: none]")
@click.option("--rival/--no-rival", default=True, show_default=True, help="Whether to run the paper's settings.")
@click.option("--threads", type=click.IntRange(1), default=None, help="CPU threads; torch's own choice if not given.")
@click.option(
    "--out", type=click.Path(path_type=Path), default=None, help="JSON file for the figures; kept up to date."
)
def main(seeds: int, rival: bool, out: Path | None, **given: Any) -> None:
    """Measure the time to quality of the default settings and of the paper's."""
    options = Options(**given)
    pool = open_shards(options.shards)
    facts = {"bar, ROC AUC of last steps": options.auc, "limit, times ours": options.limit}
    rows: list[dict[str, Any]] = []
    for row in rows_of(options, pool, seeds, rival):
        rows.append(row)
        ratios = [found["times ours"] for found in rows if found["settings"] == PAPER]
        numbers = [ratio for ratio in ratios if isinstance(ratio, float)]
        least = statistics.median([*numbers, *[options.limit] * (len(ratios) - len(numbers))]) if ratios else None
        more = "at least " if len(numbers) < len(ratios) else ""
        headline = f"{more}{least:.3g}" if least is not None else None
        report("Time to quality of mc", rows, facts | {"the paper's time over ours, median": headline}, out)


if __name__ == "__main__":
    main()
