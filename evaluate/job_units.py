"""Evaluations as a plan: a unit for each job, a table of what will be done, and one table of results."""

import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from graspq.common.errors import UserError
from graspq.common.files import writable_folder
from graspq.common.text import aligned
from graspq.engine.plan import Ending, carry_out
from graspq.evaluate.evaluation import Prepared, prepare, run_prepared
from graspq.evaluate.jobs import Job
from graspq.evaluate.over_seeds import lines_over_seeds, over_seeds
from graspq.evaluate.records import EpisodeRow, Evaluation
from graspq.evaluate.results_table import scored, write_results
from graspq.evaluate.settings import EvalSettings
from graspq.evaluate.statistics import wilson_interval


@dataclass(frozen=True)
class Planned:
    """A job of a plan; a `Unit`.

    Attributes:
        job: the job.
        settings: of the command.
        place: of the job in the plan, such as `[1/3] `.
        prepared: what it needs; None where that is not there.
        missing: what is not there, in one line.
    """

    job: Job
    settings: EvalSettings
    place: str
    prepared: Prepared | None = None
    missing: str | None = None

    @property
    def name(self) -> str:
        """The folder of its files."""
        return self.prepared.folder.as_posix() if self.prepared is not None else self.job.label

    @property
    def evaluation(self) -> Evaluation | None:
        """The finished evaluation, if it is there."""
        return self.prepared.finished if self.prepared is not None else None

    def done(self) -> bool:
        """Return whether the evaluation is there."""
        return self.evaluation is not None

    def run(self) -> None:
        """Play the episodes and write the files.

        Raises:
            UserError: see `run_prepared`, or what it needs is not there.
        """
        if self.prepared is None:
            raise UserError(self.missing or "")
        started, episodes, ended = time.monotonic(), self.job.episodes, Counter[bool]()
        name = f"{self.place}{self.job.label}"
        with tqdm(total=episodes, desc=name, unit="grasp", file=sys.stderr, disable=None, dynamic_ncols=True) as bar:

            def count(row: EpisodeRow) -> None:
                ended[row.success] += 1
                low, high = wilson_interval(ended[True], ended.total())
                rate = ended[True] / ended.total()
                bar.set_postfix_str(f"success {100 * rate:.1f} % ± {50 * (high - low):.1f}", refresh=False)
                bar.update()

            run_prepared(self.prepared, self.settings, count)
        seconds = time.monotonic() - started
        click.echo(f"{episodes} episodes in {seconds:.0f} s, {episodes / seconds:.1f} a second", err=True)

    @property
    def status(self) -> str:
        """What will be done about it, in a word or a line."""
        if self.prepared is None:
            return f"cannot run: {self.missing}"
        return "finished" if self.done() else "to do"


def make_plan(jobs: Sequence[Job], settings: EvalSettings) -> list[Planned]:
    """Find what each job needs; jobs without a run take their scenes from those with one.

    Raises:
        UserError: the only job cannot be run.
    """
    plan: dict[int, Planned] = {}
    for number, job in sorted(enumerate(jobs), key=lambda numbered: numbered[1].run is None):
        place = f"[{number + 1}/{len(jobs)}] " if len(jobs) > 1 else ""
        beside = [other.prepared for other in plan.values() if other.prepared is not None]
        try:
            plan[number] = Planned(job, settings, place, prepare(job, settings, beside))
        except UserError as error:
            if len(jobs) == 1:
                raise
            plan[number] = Planned(job, settings, place, missing=error.message)
    return [plan[number] for number in range(len(jobs))]


def plan_table(plan: Sequence[Planned]) -> str:
    """Return the plan for the terminal: a line for each job."""
    rows = [("policy", "task", "split", "seed", "episodes", "object set", "")]
    for planned in plan:
        job, prepared = planned.job, planned.prepared
        task = prepared.task.settings.name if prepared is not None else job.task or "?"
        objects = prepared.objects.folder.as_posix() if prepared is not None else str(job.objects or "?")
        rows.append((job.label, task, job.split, str(job.seed), str(job.episodes), objects, planned.status))
    return aligned(rows)


def run_plan(plan: Sequence[Planned], settings: EvalSettings, table: Path | None) -> bool:
    """Run what is to do, in order; return whether every job is finished.

    Args:
        plan: the jobs.
        settings: of the command.
        table: folder of `results.jsonl` and `results.csv`, rewritten after every job; None for none.

    Raises:
        UserError: the only job fails, or the table cannot be written.
    """
    failed, rows, finished = False, list[dict[str, Any]](), list[Evaluation]()

    def report(ending: Ending[Planned]) -> None:
        nonlocal failed
        failed |= ending.error is not None
        # Read once: reading checks the digests of all its files.
        evaluation = ending.unit.evaluation if ending.error is None else None
        click.echo(_line(ending, evaluation), err=ending.error is not None)
        finished.extend([evaluation] if evaluation is not None else [])
        if table is not None:
            writable_folder(table, "results table")
            rows.append(_row(ending, evaluation))
            write_results(table, rows)

    carry_out(plan, report, again=settings.again, keep_going=len(plan) > 1)
    means = lines_over_seeds(over_seeds(finished))
    if means:
        click.echo(means)
    return not failed


def _line(ending: Ending[Planned], evaluation: Evaluation | None) -> str:
    """Return what became of a job, for the terminal."""
    label = ending.unit.job.label
    if evaluation is None:
        return f"{label}: failed: {ending.error}"
    summary = evaluation.summary
    low, high = summary["ci95"]
    return (
        f"{label}: {100 * summary['success_rate']:.1f} % of {summary['episodes']} grasps succeeded "
        f"(95 %: {100 * low:.1f} to {100 * high:.1f}), {summary['task']} {summary['split']}, "
        f"{evaluation.folder.as_posix()}"
    )


def _row(ending: Ending[Planned], evaluation: Evaluation | None) -> dict[str, Any]:
    """Return a job's row of the table of results."""
    job = ending.unit.job
    if evaluation is not None:
        return {"status": "finished", **scored(evaluation)}
    named = {name: getattr(job, name) for name in ("label", "policy", "task", "split", "seed", "episodes")}
    run = job.run.as_posix() if job.run is not None else None
    return {"status": "failed", **named, "run": run, "error": ending.error}
