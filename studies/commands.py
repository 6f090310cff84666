"""The commands of a job, and the check that this installation can run them before the first one starts.

A job trains with `grasp-train` or `grasp-online` and is scored with `grasp-eval`, in processes of their own.
"""

import importlib
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

import click

from graspq.common.errors import UserError
from graspq.datasets.dataset import open_shards
from graspq.evaluate.scenes import SET_FILE
from graspq.studies.plan import GRASPS_PER_ROUND, STEPS_PER_ROUND, Job, Plan
from graspq.studies.state import SCENES_SEED, State, run_folder, run_of

MODULES = {
    "grasp-train": "graspq.train.cli",
    "grasp-online": "graspq.online.cli",
    "grasp-eval": "graspq.evaluate.cli",
}


@dataclass(frozen=True)
class CommandLine:
    """A console script and its arguments."""

    script: str
    arguments: tuple[str, ...]

    def __str__(self) -> str:
        return shlex.join([self.script, *self.arguments])

    @property
    def words(self) -> list[str]:
        """Return the words to start it with: the script that was installed beside this Python."""
        return [str(Path(sys.executable).with_name(self.script)), *self.arguments]


@dataclass(frozen=True)
class Means:
    """What a job may use, which changes no result.

    Attributes:
        threads: CPU threads.
        device: where networks run.
    """

    threads: int
    device: str = "auto"


def training_command(folder: Path, plan: Plan, job: Job, means: Means) -> CommandLine:
    """Return the command that trains a job to its last step, from where it is."""
    words = ["--algo", job.algo, "--shards", *plan.shards, "--preset", "paper"]
    words += ["--learning-rate", f"{job.learning_rate:.12g}", "--width", str(job.width)]
    words += ["--discount", f"{job.discount:.12g}"] if job.discount is not None else []
    words += ["--seed", str(job.seed), "--threads", str(means.threads), "--device", means.device]
    words += ["--out", str(run_folder(folder, job))]
    if not plan.on_policy:
        return CommandLine("grasp-train", (*words, "--steps", str(plan.steps)))
    rounds = str(plan.steps // STEPS_PER_ROUND)
    words += ["--rounds", rounds, "--steps-per-round", str(STEPS_PER_ROUND), "--grasps", str(GRASPS_PER_ROUND)]
    words += ["--exploration-steps", str(job.exploration_steps), "--workers", str(means.threads)]
    words += ["--objects", plan.objects] if plan.objects is not None else []
    return CommandLine("grasp-online", tuple(words))


def evaluation_command(folder: Path, plan: Plan, job: Job, means: Means) -> CommandLine:
    """Return the command that scores a job's run."""
    words = [str(run_folder(folder, job)), "--split", plan.split, "--episodes", str(plan.episodes)]
    words += ["--seed", str(SCENES_SEED), "--workers", str(means.threads), "--device", means.device]
    words += ["--objects", plan.objects] if plan.objects is not None else []
    return CommandLine("grasp-eval", tuple(words))


def next_command(folder: Path, plan: Plan, state: State, means: Means) -> CommandLine | None:
    """Return what a job needs next, or None where it is done."""
    if state.evaluation is not None:
        return None
    command = training_command if state.steps < plan.steps else evaluation_command
    return command(folder, plan, state.job, means)


def check_commands(folder: Path, plan: Plan, jobs: list[Job], means: Means) -> None:
    """Refuse jobs whose commands this installation does not have or understand.

    Raises:
        UserError: a command is missing, or does not know an option or an estimator; nothing was run.
    """
    for job in jobs:
        for command in (training_command(folder, plan, job, means), evaluation_command(folder, plan, job, means)):
            try:
                main: click.Command = importlib.import_module(MODULES[command.script]).main
                main.make_context(command.script, list(command.arguments))
            except ModuleNotFoundError as error:
                if not str(error.name).startswith("graspq."):
                    raise
                raise UserError(
                    f"{job.id}: needs {command.script}, which this version of graspq does not have; "
                    "nothing was run; --dry-run prints the plan"
                ) from None
            except click.ClickException as error:
                raise UserError(
                    f"{job.id}: {command.script} cannot run it: {error.format_message()}; nothing was run, "
                    "--algo names the estimators to plan"
                ) from None


def check_data(folder: Path, plan: Plan) -> None:
    """Refuse a plan whose data or scenes are not there, or whose runs learned from other data.

    Raises:
        UserError: the data, the simulator, the object set or its split is missing, or the data are others than before.
    """
    from graspq.evaluate.evaluation import prepare
    from graspq.evaluate.jobs import Job as Evaluation
    from graspq.evaluate.records import RANDOM
    from graspq.evaluate.settings import EvalSettings

    pool = open_shards(plan.shards, verify=False)
    beside = (folder / "objects" for folder in pool.folders)
    own = next((path for path in beside if (path / SET_FILE).is_file()), None)
    objects = Path(plan.objects) if plan.objects is not None else own
    prepare(Evaluation(None, RANDOM, pool.task["name"], plan.split, objects=objects), EvalSettings(policy=(RANDOM,)))
    for job in [] if plan.on_policy else plan.jobs:
        run = run_of(run_folder(folder, job))
        if run is not None and run.config.get("dataset", {}).get("manifest_sha256") != pool.manifest_digest:
            raise UserError(f"{run.folder}: learned from other data than {' '.join(plan.shards)}; choose another --out")
