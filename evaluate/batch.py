"""Batches of jobs: the plan as a table, one job after the other, and one table of results.

A job that fails leaves the others alone; what is finished already is not run again.
"""

import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from graspq.common.errors import UserError
from graspq.common.files import writable_folder
from graspq.common.text import aligned, write_csv, write_jsonl
from graspq.evaluate.evaluation import Prepared, prepare, run_prepared
from graspq.evaluate.jobs import Job
from graspq.evaluate.records import EpisodeRow, Evaluation
from graspq.evaluate.settings import EvalSettings
from graspq.evaluate.statistics import wilson_interval

COLUMNS = (
    "label", "policy", "run", "algo", "checkpoint_step", "task", "split", "seed", "episodes", "status", "successes",
    "success_rate", "ci95_low", "ci95_high", "mean_steps", "object_set", "object_set_sha256", "folder", "error",
)  # fmt: skip


@dataclass(frozen=True)
class Planned:
    """A job of a plan.

    Attributes:
        job: the job.
        prepared: what it needs; None where that is not there.
        evaluation: the finished evaluation, if it is there.
        error: why it cannot be run, or why it failed.
    """

    job: Job
    prepared: Prepared | None = None
    evaluation: Evaluation | None = None
    error: str | None = None

    @property
    def status(self) -> str:
        """Return what will be done about it, in a word or a line."""
        if self.prepared is None:
            return f"cannot run: {self.error}"
        return "finished" if self.evaluation is not None else "to do"

    @property
    def line(self) -> str:
        """Return its result in one line."""
        if self.evaluation is None:
            return f"{self.job.label}: failed: {self.error}"
        summary = self.evaluation.summary
        low, high = summary["ci95"]
        return (
            f"{self.job.label}: {100 * summary['success_rate']:.1f} % of {summary['episodes']} grasps succeeded "
            f"(95 %: {100 * low:.1f} to {100 * high:.1f}), {summary['task']} {summary['split']}, "
            f"{self.evaluation.folder.as_posix()}"
        )

    def row(self) -> dict[str, Any]:
        """Return its row of the table of results."""
        row: dict[str, Any] = dict.fromkeys(COLUMNS)
        row |= {
            "label": self.job.label,
            "policy": self.job.policy,
            "run": self.job.run.as_posix() if self.job.run is not None else None,
            "task": self.job.task,
            "split": self.job.split,
            "seed": self.job.seed,
            "episodes": self.job.episodes,
            "status": "failed" if self.evaluation is None else "finished",
            "error": self.error,
        }
        if self.evaluation is not None:
            summary = self.evaluation.summary
            row |= {name: summary[name] for name in COLUMNS if name in summary and name != "object_set"}
            row["ci95_low"], row["ci95_high"] = summary["ci95"]
            row["object_set"], row["object_set_sha256"] = summary["object_set"]["name"], summary["object_set"]["sha256"]
            row["folder"] = self.evaluation.folder.as_posix()
        return row


def make_plan(jobs: Sequence[Job], settings: EvalSettings) -> list[Planned]:
    """Find what each job needs; jobs without a run take their scenes from those with one.

    Raises:
        UserError: the only job cannot be run.
    """
    plan: dict[Job, Planned] = {}
    for job in sorted(jobs, key=lambda job: job.run is None):
        beside = [other.prepared for other in plan.values() if other.prepared is not None]
        try:
            prepared = prepare(job, settings, beside)
            plan[job] = Planned(job, prepared, prepared.finished)
        except UserError as error:
            if len(jobs) == 1:
                raise
            plan[job] = Planned(job, error=error.message)
    return [plan[job] for job in jobs]


def plan_table(plan: Sequence[Planned]) -> str:
    """Return the plan for the terminal: a line for each job."""
    rows = [("policy", "task", "split", "seed", "episodes", "object set", "")]
    for planned in plan:
        job, prepared = planned.job, planned.prepared
        task = prepared.task.settings.name if prepared is not None else job.task or "?"
        objects = prepared.objects.folder.as_posix() if prepared is not None else str(job.objects or "?")
        rows.append((job.label, task, job.split, str(job.seed), str(job.episodes), objects, planned.status))
    return aligned(rows)


def run_plan(plan: Sequence[Planned], settings: EvalSettings, table: Path | None) -> list[Planned]:
    """Run what is to do, in order, and return the plan with its results.

    Args:
        plan: the jobs.
        settings: of the command.
        table: folder of `results.jsonl` and `results.csv`, rewritten after every job; None for none.

    Raises:
        UserError: the only job fails.
    """
    results: list[Planned] = []
    for number, planned in enumerate(plan, start=1):
        if planned.prepared is None or (planned.evaluation is not None and not settings.again):
            results.append(planned)
        else:
            place = f"[{number}/{len(plan)}] " if len(plan) > 1 else ""
            results.append(_run(planned, planned.prepared, settings, place, alone=len(plan) == 1))
        click.echo(results[-1].line, err=results[-1].evaluation is None)
        if table is not None:
            write_table(table, results)
    return results


def _run(planned: Planned, prepared: Prepared, settings: EvalSettings, place: str, *, alone: bool) -> Planned:
    started = time.monotonic()
    episodes = prepared.job.episodes
    try:
        with Progress(f"{place}{prepared.job.label}", episodes) as progress:
            evaluation = run_prepared(prepared, settings, progress.add)
    except UserError as error:
        if alone:
            raise
        return replace(planned, evaluation=None, error=error.message)
    except Exception as error:  # a defect: the others go on, and its traceback is shown
        if alone:
            raise
        traceback.print_exc()
        return replace(planned, evaluation=None, error=f"{type(error).__name__}: {error}")
    seconds = time.monotonic() - started
    click.echo(f"{episodes} episodes in {seconds:.0f} s, {episodes / seconds:.1f} a second", err=True)
    return replace(planned, evaluation=evaluation)


def write_table(folder: Path, results: Sequence[Planned]) -> None:
    """Write `results.jsonl` and `results.csv`, a row for each job, atomically.

    Raises:
        UserError: the folder cannot be written.
    """
    writable_folder(folder, "results table")
    rows = [result.row() for result in results]
    write_jsonl(folder / "results.jsonl", rows)
    write_csv(folder / "results.csv", COLUMNS, rows)


class Progress:
    """A progress bar of one job: episodes, success so far with its interval, time left."""

    def __init__(self, name: str, episodes: int) -> None:
        self._bar = tqdm(total=episodes, desc=name, unit="grasp", file=sys.stderr, disable=None, dynamic_ncols=True)
        self._successes = self._episodes = 0

    def add(self, row: EpisodeRow) -> None:
        """Count an episode that has ended."""
        self._episodes += 1
        self._successes += row.success
        low, high = wilson_interval(self._successes, self._episodes)
        rate = self._successes / self._episodes
        self._bar.set_postfix_str(f"success {100 * rate:.1f} % ± {50 * (high - low):.1f}", refresh=False)
        self._bar.update()

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *error: Any) -> None:
        self._bar.close()
