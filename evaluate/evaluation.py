"""One evaluation from job to files: what it needs is found and checked first, then it runs, then it is written.

The scenes follow from the job; `eval.json` holds no times and no hosts, so the same job gives the same file.
"""

import contextlib
import json
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from graspq.common.errors import UserError, said_of
from graspq.common.files import LOCK_NAME, locked, remove_temporaries, writable_folder
from graspq.common.named_objects import source_digest
from graspq.common.provenance import code_revision, versions
from graspq.evaluate.films import write_films
from graspq.evaluate.jobs import Job
from graspq.evaluate.records import (
    ACTOR,
    CEM,
    FORMAT_VERSION,
    EpisodeRow,
    Evaluation,
    finished_in,
    identity_digest,
    write_rows,
    write_summary,
)
from graspq.evaluate.rollout import Rollouts, run_rollouts
from graspq.evaluate.scenes import Scenes, datasets_of, find_object_set, object_set_of, refuse_trained_objects
from graspq.evaluate.settings import EvalSettings
from graspq.evaluate.statistics import wilson_interval
from graspq.objects.object_set import ObjectSet
from graspq.policies.named import ScoredPolicy, policy_named
from graspq.sim.task import Task, task_from_json, task_named

if TYPE_CHECKING:
    from graspq.policies.of_run import RunPolicy

BASELINES = Path("runs/baselines")
PACKAGES = ("numpy", "pybullet", "pybullet-arm64", "torch")


@dataclass(frozen=True)
class Prepared:
    """A job whose run, task and object set are found.

    Attributes:
        job: the job.
        scenes: what its episodes begin with.
        objects: its object set, verified.
        policy: who acts.
        run: the same, where it is a run's.
        identity: all that determines the result; the same identity is the same job.
        folder: where its files are or will be.
    """

    job: Job
    scenes: Scenes
    objects: ObjectSet
    policy: ScoredPolicy
    run: "RunPolicy | None"
    identity: dict[str, Any]
    folder: Path

    @property
    def finished(self) -> Evaluation | None:
        """The evaluation, if it is there and whole."""
        return finished_in(self.folder)

    @property
    def task(self) -> Task:
        """The task."""
        return self.scenes.task

    @property
    def rollouts(self) -> Rollouts:
        """What the workers do."""
        return Rollouts(self.scenes, self.policy)


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
    run = _run_policy(job, settings)
    policy: ScoredPolicy = run if run is not None else policy_named(str(job.policy))
    task, objects = _task_and_objects(job, run, beside)
    if run is not None:
        _check_fit(job, run, task)
        config = run.origin.config
        if not refuse_trained_objects(objects, job.split, object_set_of(config), datasets_of(config)):
            click.echo(
                f"{objects.folder}: another object set than that of {job.run}, whose data are not here: whether it was "
                "trained on these objects cannot be told",
                err=True,
            )
    task.draw(objects, job.split, np.random.default_rng(0))  # refuses a split that is not there
    identity = {
        "simulator": versions("pybullet", "pybullet-arm64", "numpy"),
        "task": task.settings.to_json(),
        "task_source": source_digest(task.settings.name) if ":" in task.settings.name else None,
        "split": job.split,
        "seed": job.seed,
        "episodes": job.episodes,
        "object_set": objects.digest(),
        "policy": job.policy,
        **policy.identity(),
    }
    taken = [other.folder for other in beside if other.identity != identity]
    folder = _place(job, task.settings.name, settings.out, identity, taken)
    scenes = Scenes(task, objects.folder, job.split, job.seed)
    return Prepared(job, scenes, objects, policy, run, identity, folder)


def _check_simulator() -> None:
    import importlib.util

    if importlib.util.find_spec("pybullet") is None:
        raise UserError("evaluation needs the simulator, and PyBullet is not installed; run: pip install 'graspq[sim]'")


def _run_policy(job: Job, settings: EvalSettings) -> "RunPolicy | None":
    if job.run is None:
        return None
    # Imported late: the other policies need no PyTorch.
    from graspq.policies.of_run import load

    return load(job.run, job.checkpoint, cem=job.cem, device=settings.device)


def _task_and_objects(job: Job, run: "RunPolicy | None", beside: Sequence[Prepared]) -> tuple[Task, ObjectSet]:
    """Return what a job's scenes are made of."""
    name = job.task or (str(run.origin.task["name"]) if run is not None else _common_task(beside))
    if run is not None and run.origin.task["name"] == name:
        config = run.origin.config
        with said_of(f"{job.run}, its config.json"):
            task = task_from_json(run.origin.task)
        return task, find_object_set(task, job.objects, object_set_of(config), datasets_of(config))
    same = [other for other in beside if other.run is not None and other.task.settings.name == name]
    task = same[0].task if same and run is None else task_named(name)
    return task, find_object_set(task, job.objects, None, (), [other.objects.folder for other in same])


def _common_task(beside: Sequence[Prepared]) -> str:
    """Return the task that the runs of a plan have in common; `regular` where there are none or several."""
    names = {other.task.settings.name for other in beside if other.run is not None}
    return names.pop() if len(names) == 1 else "regular"


def _check_fit(job: Job, run: "RunPolicy", task: Task) -> None:
    """Refuse a network that was trained on other images or actions than the task's."""
    specification, size = run.origin.specification, task.settings.image_size
    pairs = (
        ("images", tuple(specification.image_shape), (size, size, 3)),
        ("action limits", run.acting.action.limits, task.action.limits),
        ("steps", specification.steps, task.settings.max_steps),
    )
    for what, there, here in pairs:
        if there != here:
            raise UserError(
                f"{job.run}: trained with {what} {there}, the {task.settings.name} task has {here}; name its own --task"
            )


def _place(job: Job, task: str, out: Path | None, identity: dict[str, Any], taken: Sequence[Path]) -> Path:
    """Return the job's folder; another job's evaluation, there or still to do, is never overwritten."""
    name = f"{task}-{job.split}-seed{job.seed}-{job.episodes}".replace(":", ".")
    if out is not None or job.run is None:
        parent, name = out if out is not None else BASELINES, f"{job.label.replace(':', '.')}-{name}"
    else:
        parent = job.run / "evaluations"
    first = parent / name
    found = finished_in(first)
    free = first not in taken if found is None else found.summary["job"] == identity
    return first if free else parent / f"{name}-{identity_digest(identity)[:8]}"


def run_prepared(
    prepared: Prepared, settings: EvalSettings, on_row: Callable[[EpisodeRow], None] | None = None
) -> Evaluation:
    """Run a prepared job and write its files; one that another process has finished meanwhile is returned.

    Raises:
        UserError: the folder cannot be written, another process works there or has put another evaluation there, a
            user's policy fails, or episodes end their simulators each time.
    """
    folder = writable_folder(prepared.folder, "evaluation")
    with locked(folder, "grasp-eval"):
        remove_temporaries(folder)
        there = finished_in(folder)
        if there is not None and there.summary["job"] != prepared.identity:
            raise UserError(f"{folder}: another evaluation has come here meanwhile; run the same command again")
        if there is not None and not settings.again:
            return there
        try:
            rows, films = run_rollouts(
                prepared.rollouts, prepared.job.episodes, settings.where, films=settings.films, on_row=on_row
            )
        except BaseException:
            if [path.name for path in folder.iterdir()] == [LOCK_NAME]:  # nothing of an unfinished one stays
                with contextlib.suppress(OSError):
                    (folder / LOCK_NAME).unlink()
                    folder.rmdir()
            raise
        write_rows(folder, rows)
        write_films(folder, films)
        return write_summary(folder, _summary(prepared, rows))


def _summary(prepared: Prepared, rows: Sequence[EpisodeRow]) -> dict[str, Any]:
    job, run = prepared.job, prepared.run
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
        "ends": {end: sum(row.ended_by == end for row in rows) for end in ("height", "T")},
        "policy": job.policy or (CEM if search is not None else ACTOR),
        "run": job.run.as_posix() if job.run is not None else None,
        "algo": run.origin.algo if run is not None else None,
        "checkpoint_step": run.origin.step if run is not None else None,
        **_origin(job, run),
        "seed": job.seed,
        "object_set": {"name": prepared.objects.name, "sha256": prepared.objects.digest()},
        "cem": search,
        "command": command_of(job),
        "versions": versions(*PACKAGES),
        "code_revision": code_revision(),
        "job": json.loads(json.dumps(prepared.identity)),
    }


def _origin(job: Job, run: "RunPolicy | None") -> dict[str, Any]:
    """Return what a run was made of: its seed, data, recipe and code."""
    if run is None:
        return dict.fromkeys(("training_seed", "data_sha256", "recipe_sha256", "trained_by"))
    # Imported late: it needs PyTorch.
    from graspq.evaluate.recipe_digest import recipe_digest

    config = run.origin.config
    return {
        "training_seed": config["settings"].get("seed"),
        "data_sha256": config["dataset"].get("manifest_sha256"),
        "recipe_sha256": recipe_digest(config, job.cem),
        "trained_by": config.get("code_revision"),
    }


def command_of(job: Job) -> str:
    """Return the command line that makes an evaluation again; options at their defaults are left out."""
    words = ["grasp-eval", *([job.run.as_posix()] if job.run is not None else ["--policy", str(job.policy)])]
    words += ["--task", job.task] if job.task is not None else []
    words += ["--split", job.split, "--episodes", str(job.episodes), "--seed", str(job.seed)]
    words += ["--objects", job.objects.as_posix()] if job.objects is not None else []
    words += ["--checkpoint", str(job.checkpoint)] if job.checkpoint is not None else []
    return shlex.join([*words, *job.cem.words()])
