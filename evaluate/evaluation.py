"""One evaluation from job to files: what it needs is found and checked first, then it runs, then it is written.

The scenes follow from the job; `eval.json` holds no times and no hosts, so the same job gives the same file.
"""

import contextlib
import json
import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from graspq.common.errors import UserError
from graspq.common.files import writable_folder
from graspq.common.options import flag
from graspq.common.provenance import code_revision, versions
from graspq.evaluate.films import FilmKeeper, write_films
from graspq.evaluate.jobs import Job
from graspq.evaluate.object_sets import find_object_set
from graspq.evaluate.policies import ACTOR, CEM, ORACLE, RANDOM, Policy, RandomObservationPolicy, UserPolicy
from graspq.evaluate.records import (
    EPISODES_FILE,
    FORMAT_VERSION,
    EpisodeRow,
    Evaluation,
    identity_digest,
    write_rows,
    write_summary,
)
from graspq.evaluate.settings import GROUP, CemSettings, EvalSettings
from graspq.evaluate.statistics import wilson_interval

if TYPE_CHECKING:
    from graspq.evaluate.runs import RunFacts
    from graspq.objects.object_set import ObjectSet
    from graspq.sim.task import Task

BASELINES = Path("runs/baselines")
PACKAGES = ("numpy", "pybullet", "torch")


@dataclass(frozen=True)
class Prepared:
    """A job whose run, task and object set are found.

    Attributes:
        job: the job.
        task: settings of its task.
        objects: its object set, verified.
        facts: what the run's folder says; None without a run.
        policy: who decides; None for the oracle.
        identity: all that determines the result; the same identity is the same job.
        folder: where its files are or will be.
        finished: the evaluation, if it is there already.
    """

    job: Job
    task: "Task"
    objects: "ObjectSet"
    facts: "RunFacts | None"
    policy: Policy | None
    identity: dict[str, Any]
    folder: Path
    finished: Evaluation | None


def prepare(job: Job, settings: EvalSettings, beside: Sequence[Prepared] = ()) -> Prepared:
    """Find everything that a job needs.

    Args:
        job: the job.
        settings: of the command.
        beside: jobs of the same plan that are prepared already: a policy without a run meets the scenes of the first of
            them that has the same task, its settings and object set, so that the two can be compared.

    Raises:
        UserError: PyBullet, the run, its checkpoint, the task, the object set, its split or the policy is not there.
    """
    _check_simulator()
    policy, facts = _policy(job, settings)
    task, objects = _scenes(job, facts, beside)
    _check_fit(job, facts, task)
    task.draw(objects, job.split, np.random.default_rng(0))  # refuses a split that is not there
    identity = {
        "simulator": versions("pybullet", "numpy"),
        "task": task.settings.to_json(),
        "split": job.split,
        "seed": job.seed,
        "episodes": job.episodes,
        "environments": job.environments,
        "rows_of_a_batch": GROUP,  # they round together
        "object_set": objects.digest(),
        "policy": job.policy,
        "network": facts.network_sha256 if facts is not None else None,
        **(policy.identity() if policy is not None else {}),
    }
    folder, finished = _place(job, task.settings.name, settings.out, identity)
    return Prepared(job, task, objects, facts, policy, identity, folder, finished)


def _check_simulator() -> None:
    import importlib.util

    if importlib.util.find_spec("pybullet") is None:
        raise UserError("evaluation needs the simulator, and PyBullet is not installed; run: pip install 'graspq[sim]'")


def _policy(job: Job, settings: EvalSettings) -> "tuple[Policy | None, RunFacts | None]":
    if job.run is not None:
        from graspq.evaluate.runs import load_run

        return load_run(job.run, job.checkpoint, job.cem, settings.device)
    assert job.policy is not None
    if job.policy == ORACLE:
        return None, None
    return RandomObservationPolicy() if job.policy == RANDOM else UserPolicy.load(job.policy), None


def _scenes(job: Job, facts: "RunFacts | None", beside: Sequence[Prepared]) -> "tuple[Task, ObjectSet]":
    """Return the task and the object set that a job's scenes are made of."""
    from graspq.sim.task import task_from_json, task_named

    name = job.task or (str(facts.task["name"]) if facts is not None else _common_task(beside))
    if facts is not None and facts.task["name"] == name:
        task = task_from_json(facts.task)
        return task, find_object_set(task, job.objects, facts.object_set, facts.datasets)
    same = [other for other in beside if other.facts is not None and other.task.settings.name == name]
    task = same[0].task if same and facts is None else task_named(name)
    return task, find_object_set(task, job.objects, None, (), [other.objects.folder for other in same])


def _common_task(beside: Sequence[Prepared]) -> str:
    """Return the task that the runs of a plan have in common; `regular` where there are none or several."""
    names = {other.task.settings.name for other in beside if other.facts is not None}
    return names.pop() if len(names) == 1 else "regular"


def _check_fit(job: Job, facts: "RunFacts | None", task: "Task") -> None:
    """Refuse a network that was trained on other images or actions than the task's."""
    if facts is None:
        return
    shape = (task.settings.image_size, task.settings.image_size, 3)
    pairs = (
        ("images", facts.image_shape, shape),
        ("action limits", facts.action_limits, task.action.limits),
        ("steps", facts.steps, task.settings.max_steps),
    )
    for what, run, here in pairs:
        if run != here:
            raise UserError(
                f"{job.run}: trained with {what} {run}, the {task.settings.name} task has {here}; name its own --task"
            )


def _place(job: Job, task: str, out: Path | None, identity: dict[str, Any]) -> tuple[Path, Evaluation | None]:
    """Return the job's folder, and its evaluation if it is finished; another job's evaluation is never overwritten."""
    name = f"{task}-{job.split}-seed{job.seed}-{job.episodes}"
    if out is not None or job.run is None:
        parent, name = out if out is not None else BASELINES, f"{job.label.replace(':', '.')}-{name}"
    else:
        parent = job.run / "evaluations"
    first = parent / name
    found = _evaluation_in(first)
    if found is None or found.summary["job"] == identity:
        return first, found
    second = parent / f"{name}-{identity_digest(identity)[:8]}"
    return second, _evaluation_in(second)


def _evaluation_in(folder: Path) -> Evaluation | None:
    try:
        found = Evaluation.load(folder)
    except UserError:
        return None
    return found if found.has(EPISODES_FILE) else None


def run_prepared(
    prepared: Prepared, settings: EvalSettings, on_row: Callable[[EpisodeRow], None] | None = None
) -> Evaluation:
    """Run a prepared job and write its files.

    Raises:
        UserError: the folder cannot be written, or a user's policy fails.
        RolloutError: an episode ends its simulator each time.
    """
    folder = writable_folder(prepared.folder, "evaluation")
    try:
        rows, films = play(prepared, settings, on_row)
    except BaseException:
        with contextlib.suppress(OSError):
            folder.rmdir()  # only if it is empty: nothing of an unfinished evaluation stays
        raise
    write_rows(folder, rows)
    write_films(folder, films.chosen())
    return write_summary(folder, _summary(prepared, rows))


def play(
    prepared: Prepared, settings: EvalSettings, on_row: Callable[[EpisodeRow], None] | None = None
) -> tuple[Sequence[EpisodeRow], FilmKeeper]:
    """Run the episodes of a prepared job; return their rows in order, and the films. See `rollout.run_episodes`."""
    from graspq.evaluate.rollout import run_episodes

    with _one_thread() if prepared.facts is not None else contextlib.nullcontext():
        return run_episodes(
            stage_of(prepared),
            prepared.policy,
            episodes=prepared.job.episodes,
            environments=prepared.job.environments,
            workers=settings.workers,
            films=settings.films,
            on_row=on_row,
        )


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Let PyTorch compute in one thread.

    The simulators keep the cores busy, so threads of one decision would wait for each other: with two on two cores an
    evaluation was a third slower. And rounding does not depend on the number of cores.
    """
    import torch

    usual = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(usual)


def stage_of(prepared: Prepared) -> Any:
    """Return what the workers need to know of a job."""
    from graspq.evaluate.workers import Stage

    job = prepared.job
    return Stage(
        prepared.task.settings.to_json(), str(prepared.objects.folder), job.split, job.seed, job.policy == ORACLE
    )


def _summary(prepared: Prepared, rows: Sequence[EpisodeRow]) -> dict[str, Any]:
    job, facts = prepared.job, prepared.facts
    search = prepared.identity.get("cem")
    successes = sum(row.success for row in rows)
    return {
        "format_version": FORMAT_VERSION,
        "label": job.label,
        "task": prepared.task.settings.name,
        "split": job.split,
        "episodes": len(rows),
        "successes": successes,
        "success_rate": successes / len(rows),
        "ci95": list(wilson_interval(successes, len(rows))),
        "mean_steps": float(np.mean([row.steps for row in rows])),
        "mean_return": float(np.mean([row.episode_return for row in rows])),
        "ends": {end: sum(row.end == end for row in rows) for end in ("height", "T")},
        "policy": job.policy or (CEM if search is not None else ACTOR),
        "run": job.run.as_posix() if job.run is not None else None,
        "algo": facts.algo if facts is not None else None,
        "checkpoint_step": facts.step if facts is not None else None,
        "seed": job.seed,
        "object_set": {"name": prepared.objects.name, "sha256": prepared.objects.digest()},
        "cem": search,
        "command": command_of(job),
        "versions": versions(*PACKAGES),
        "code_revision": code_revision(),
        "job": json.loads(json.dumps(prepared.identity)),
    }


def command_of(job: Job) -> str:
    """Return the command line that makes an evaluation again; options at their defaults are left out."""
    words = ["grasp-eval", *([job.run.as_posix()] if job.run is not None else ["--policy", str(job.policy)])]
    words += ["--task", job.task] if job.task is not None else []
    words += ["--split", job.split, "--episodes", str(job.episodes), "--seed", str(job.seed)]
    words += ["--objects", job.objects.as_posix()] if job.objects is not None else []
    words += ["--checkpoint", str(job.checkpoint)] if job.checkpoint is not None else []
    words += ["--environments", str(job.environments)] if job.environments != EvalSettings.environments else []
    usual = CemSettings()
    for name, value in job.cem.to_json().items():
        if value != getattr(usual, name):
            words += [flag(f"cem_{name}"), str(value)]
    return shlex.join(words)
