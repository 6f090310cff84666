"""How far a job is, asked of its own files: the run's checkpoints, the evaluation's record, the note of a failure.

Nothing here is remembered beside them, so that a sweep that was killed at any moment finds the truth again.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from graspq.common.errors import UserError
from graspq.common.files import read_json, write_json
from graspq.evaluate.records import EPISODES_FILE, Evaluation, find_evaluations
from graspq.studies.plan import Job, Plan
from graspq.train.run import Run, step_of
from graspq.train.search_settings import CemSettings

Status = Literal["done", "failed", "to do"]
SCENES_SEED = 0


@dataclass(frozen=True)
class State:
    """What a job's files say.

    Attributes:
        job: the job.
        status: `done` (trained to the last step and scored), `failed`, or `to do`.
        steps: training step of the newest checkpoint; 0 before the first.
        training_seconds: time spent in training steps that count; None before the first row of metrics.
        evaluation: the score of the last step; None before.
        reason: why it failed, in one line; None if it did not.
    """

    job: Job
    status: Status
    steps: int
    training_seconds: float | None
    evaluation: Evaluation | None
    reason: str | None


def run_folder(folder: Path, job: Job) -> Path:
    """Return where a job's training run is."""
    return folder / "runs" / job.id


def log_file(folder: Path, job: Job) -> Path:
    """Return where the output of a job's commands is."""
    return folder / "logs" / f"{job.id}.log"


def failure_file(folder: Path, job: Job) -> Path:
    """Return where it is noted that a job failed."""
    return folder / "failures" / f"{job.id}.json"


def note_failure(folder: Path, job: Job, *, command: str, exit_status: int, reason: str) -> None:
    """Note durably that a job failed; it is then not run again unless asked."""
    note = {"id": job.id, "command": command, "exit_status": exit_status, "reason": reason}
    write_json(failure_file(folder, job), note)


def state_of(folder: Path, plan: Plan, job: Job) -> State:
    """Return how far a job of the sweep in `folder` is.

    Raises:
        UserError: the note of its failure cannot be read.
    """
    run = run_of(run_folder(folder, job))
    steps = trained_steps(run)
    evaluation = _evaluation(run, plan) if run is not None and steps >= plan.steps else None
    seconds = training_seconds(run) if run is not None else None
    failed = failure_file(folder, job)
    if evaluation is not None:
        return State(job, "done", steps, seconds, evaluation, None)
    if failed.exists():
        reason = str(read_json(failed, "note of a failure")["reason"])
        return State(job, "failed", steps, seconds, None, reason)
    return State(job, "to do", steps, seconds, None, None)


def run_of(folder: Path) -> Run | None:
    """Return the training run in a folder, or None where there is none yet."""
    try:
        return Run.open(folder)
    except UserError:
        return None


def trained_steps(run: Run | None) -> int:
    """Return the step of a run's newest checkpoint; 0 without one."""
    newest = run.latest_checkpoint() if run is not None else None
    return (step_of(newest) or 0) if newest is not None else 0


def training_seconds(run: Run) -> float | None:
    """Return the seconds that a run's training steps took, over all times it was resumed; None without a row.

    Σ (steps of the row × batch size / samples per second) over the rows of `metrics.jsonl`: what was lost by a kill
    does not count, nor do validation and checkpoints.
    """
    batch_size = run.config["settings"].get("batch_size")
    seconds, last = 0.0, 0
    for row in run.metrics():
        if "samples_per_second" in row and batch_size is not None and row["samples_per_second"] > 0:
            seconds += (row["step"] - last) * batch_size / row["samples_per_second"]
            last = row["step"]
    return round(seconds, 1) if last > 0 else None


def _evaluation(run: Run, plan: Plan) -> Evaluation | None:
    """Return the evaluation of the run's last step on the plan's scenes, if it is there and whole."""
    for found in find_evaluations(run.folder / "evaluations"):
        if _fits(found.summary, plan) and found.has(EPISODES_FILE):
            return found
    return None


def _fits(summary: dict[str, Any], plan: Plan) -> bool:
    asked = {
        "checkpoint_step": plan.steps, "split": plan.split, "episodes": plan.episodes, "seed": SCENES_SEED,
    }  # fmt: skip
    usual = summary.get("cem") in (None, CemSettings().to_json())
    return usual and all(summary.get(name) == value for name, value in asked.items())
