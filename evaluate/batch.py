"""Batches of jobs: the plan as a table, one job after the other, and one table of results.

A job that fails leaves the others alone; what is finished already is not run again.
"""

import csv
import io
import json
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from graspq.common.errors import UserError
from graspq.common.files import writable_folder, write_text
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
class Entry:
    """A job in the plan: ready (with or without a finished evaluation), or refused with the reason."""

    job: Job
    prepared: Prepared | None
    error: str | None

    @property
    def status(self) -> str:
        """Return what will be done about it, in a word or a line."""
        if self.prepared is None:
            return f"cannot run: {self.error}"
        return "finished" if self.prepared.finished is not None else "to do"


@dataclass(frozen=True)
class Result:
    """What became of a job."""

    job: Job
    evaluation: Evaluation | None
    error: str | None

    def to_json(self) -> dict[str, Any]:
        """Return the row of the results table."""
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


def make_plan(jobs: Sequence[Job], settings: EvalSettings) -> list[Entry]:
    """Find what each job needs; jobs without a run take their scenes from those with one.

    Raises:
        UserError: the only job cannot be run.
    """
    entries: dict[Job, Entry] = {}
    for job in sorted(jobs, key=lambda job: job.run is None):
        beside = [entry.prepared for entry in entries.values() if entry.prepared is not None]
        try:
            entries[job] = Entry(job, prepare(job, settings, beside), None)
        except UserError as error:
            if len(jobs) == 1:
                raise
            entries[job] = Entry(job, None, error.message)
    return [entries[job] for job in jobs]


def plan_table(entries: Sequence[Entry]) -> str:
    """Return the plan for the terminal: a line for each job."""
    rows = [("policy", "task", "split", "seed", "episodes", "object set", "")]
    for entry in entries:
        job, prepared = entry.job, entry.prepared
        task = prepared.task.settings.name if prepared is not None else job.task or "?"
        objects = prepared.objects.folder.as_posix() if prepared is not None else str(job.objects or "?")
        rows.append((job.label, task, job.split, str(job.seed), str(job.episodes), objects, entry.status))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]) - 1)]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, [*widths, 0], strict=True)).rstrip() for row in rows
    ]
    return "\n".join(lines)


def run_plan(entries: Sequence[Entry], settings: EvalSettings, table: Path | None) -> list[Result]:
    """Run what is to do, in order; the table of results is rewritten after every job.

    Args:
        entries: the plan.
        settings: of the command.
        table: folder of `results.jsonl` and `results.csv`; None for none.

    Raises:
        UserError, RolloutError: the only job fails.
    """
    results: list[Result] = []
    for number, entry in enumerate(entries, start=1):
        if entry.prepared is None:
            results.append(Result(entry.job, None, entry.error))
        elif entry.prepared.finished is not None and not settings.again:
            results.append(Result(entry.job, entry.prepared.finished, None))
        else:
            place = f"[{number}/{len(entries)}] " if len(entries) > 1 else ""
            results.append(_run_one(entry.prepared, settings, place, alone=len(entries) == 1))
        click.echo(_line(results[-1]), err=results[-1].evaluation is None)
        if table is not None:
            write_table(table, results)
    return results


def _run_one(prepared: Prepared, settings: EvalSettings, place: str, *, alone: bool) -> Result:
    started = time.monotonic()
    try:
        with Progress(f"{place}{prepared.job.label}", prepared.job.episodes) as progress:
            evaluation = run_prepared(prepared, settings, progress.add)
    except click.ClickException as error:
        if alone:
            raise
        return Result(prepared.job, None, error.message)
    except Exception as error:  # a defect: the others go on, and its traceback is shown
        if alone:
            raise
        traceback.print_exc()
        return Result(prepared.job, None, f"{type(error).__name__}: {error}")
    seconds = time.monotonic() - started
    click.echo(
        f"{prepared.job.episodes} episodes in {seconds:.0f} s, {prepared.job.episodes / seconds:.1f} a second", err=True
    )
    return Result(prepared.job, evaluation, None)


def _line(result: Result) -> str:
    """Return a result in one line."""
    if result.evaluation is None:
        return f"{result.job.label}: failed: {result.error}"
    summary = result.evaluation.summary
    low, high = summary["ci95"]
    return (
        f"{result.job.label}: {100 * summary['success_rate']:.1f} % of {summary['episodes']} grasps succeeded "
        f"(95 %: {100 * low:.1f} to {100 * high:.1f}), {summary['task']} {summary['split']}, "
        f"{result.evaluation.folder.as_posix()}"
    )


def write_table(folder: Path, results: Sequence[Result]) -> None:
    """Write `results.jsonl` and `results.csv`, a row for each job, atomically.

    Raises:
        UserError: the folder cannot be written.
    """
    writable_folder(folder, "results table")
    rows = [result.to_json() for result in results]
    write_text(folder / "results.jsonl", "".join(json.dumps(row) + "\n" for row in rows))
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(folder / "results.csv", text.getvalue())


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
