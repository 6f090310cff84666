"""`grasp-eval`: score runs, the random policy, the oracle and users' policies on scenes that no training has seen.

The way on: `jobs` (what to do) -> `job_units` (the plan) -> `evaluation` -> `rollout`, played by `sim/play`.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from graspq.common.errors import UserError
from graspq.common.options import Command, options_from, with_version
from graspq.engine import warm_up
from graspq.evaluate.settings import EvalSettings

if TYPE_CHECKING:
    from graspq.evaluate.evaluation import Prepared

# What workers will import, while this process finds out what there is to do.
MODULES = ("graspq.evaluate.rollout", "graspq.sim.episode")
MODULES_OF_RUNS = ("graspq.policies.of_run", "graspq.train.networks.default")
WHAT_TEST_IS_FOR = (
    "for the one score of a recipe that is frozen; networks, settings and checkpoints are chosen on validation"
)
RESULTS = Path("runs/evaluations")


@click.command(cls=Command, name="grasp-eval")
@with_version
@options_from(EvalSettings)
def main(settings: EvalSettings) -> int:
    """Score policies in simulation on held-out objects.

    Each RUN is a folder of grasp-train (or a glob of them); its last checkpoint acts as its estimator does.
    Every policy meets the same scenes, and a result does not depend on the number of workers. Each evaluation is a
    folder with eval.json, episodes.jsonl and films.npz; several jobs also give one table, results.jsonl and
    results.csv. A job that is finished is not run again.

    A module that is named, here or in the files of a run or of its data, is imported: its code is run. A run that names
    none (no : in algo, network and task of its config.json) runs no code of its maker.

    \b
    Examples:
      grasp-eval runs/mc --episodes 1000
      grasp-eval 'runs/*' --policy random --policy oracle --out runs/scores
      grasp-eval --policy my_policy:make
      grasp-eval --jobs jobs.toml
    """
    return evaluate(settings)


def evaluate(settings: EvalSettings) -> int:
    """Run the jobs that the settings describe; return the exit status: 0, or 1 if a job failed.

    Raises:
        UserError: the settings describe no jobs, or the only job cannot be run.
    """
    if settings.engine == "local" and settings.workers != 0 and not settings.plan:
        warm_up((*MODULES, *(MODULES_OF_RUNS if settings.runs or settings.jobs is not None else ())))
    from graspq.evaluate.job_units import make_plan, plan_table, run_plan
    from graspq.evaluate.jobs import jobs_from_settings

    jobs = jobs_from_settings(settings)
    several = len(jobs) > 1
    if settings.video is not None:
        _check_video(settings.video, several)
    plan = make_plan(jobs, settings)
    for split in dict.fromkeys(job.split for job in jobs if job.split.startswith("test")):
        click.echo(f"--split {split}: {WHAT_TEST_IS_FOR}", err=True)
    if several or settings.plan:
        click.echo(plan_table(plan))
    if settings.plan:
        return int(any(planned.prepared is None for planned in plan))
    table = settings.out if settings.out is not None else _results_folder(settings) if several else None
    whole = run_plan(plan, settings, table)
    if table is not None:
        click.echo(f"results: {(table / 'results.csv').as_posix()}")
    if settings.video is not None and plan[0].prepared is not None:
        _write_video(settings, settings.video, plan[0].prepared)
    return int(not whole)


def _results_folder(settings: EvalSettings) -> Path:
    return RESULTS / settings.jobs.stem if settings.jobs is not None else RESULTS


def _check_video(path: Path, several: bool) -> None:
    from graspq.evaluate.video import check_video_path

    if several:
        raise UserError("--video: one job makes one video; name one run or one policy")
    check_video_path(path)


def _write_video(settings: EvalSettings, path: Path, prepared: "Prepared") -> None:
    from graspq.evaluate.video import write_video

    episodes = min(settings.video_episodes, prepared.job.episodes)
    successes = write_video(path, prepared.rollouts, episodes=episodes, size=settings.video_size)
    click.echo(f"video: {path} ({sum(successes)} of {len(successes)} grasps succeed in it)")
