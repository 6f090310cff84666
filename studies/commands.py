"""The commands of a job, and the check that this installation can run them before the first one starts.

A job trains with `grasp-train` or `grasp-online` and is scored with `grasp-eval`.
"""

import importlib
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from graspq.common.errors import UserError
from graspq.common.options import given_options
from graspq.datasets.dataset import open_shards
from graspq.evaluate.scenes import SET_FILE
from graspq.studies.plan import GRASPS_PER_ROUND, STEPS_PER_ROUND, Job, Plan
from graspq.studies.state import SCENES_SEED, State, run_folder, run_of
from graspq.train.settings import complete

MODULES = {
    "grasp-train": "graspq.train.cli",
    "grasp-online": "graspq.online.cli",
    "grasp-eval": "graspq.evaluate.cli",
}
PRESET = "paper"  # of the training command, where the sweep does not vary it


@dataclass(frozen=True)
class CommandLine:
    """A console script and its arguments."""

    script: str
    arguments: tuple[str, ...]

    def __str__(self) -> str:
        return shlex.join([self.script, *self.arguments])

    @property
    def main(self) -> click.Command:
        """The command behind the script."""
        found: click.Command = importlib.import_module(MODULES[self.script]).main
        return found


@dataclass(frozen=True)
class Means:
    """What a job may use, which changes no result.

    Attributes:
        threads: CPU threads.
        device: where networks run.
    """

    threads: int
    device: str = "auto"


def training_script(on_policy: bool) -> str:
    """Return the name of the script that trains."""
    return "grasp-online" if on_policy else "grasp-train"


def training_options(algo: str, on_policy: bool, chosen: Sequence[tuple[str, str]] = ()) -> dict[str, click.Option]:
    """Return the options of training by name: the common ones, and those of the estimator and of the networks.

    Args:
        algo: the estimator.
        on_policy: whether `grasp-online` trains.
        chosen: values of `preset` and `network`, which decide what other options there are.

    Raises:
        UserError: there is no such estimator or network.
    """
    command = CommandLine(training_script(on_policy), ())
    words = ["--algo", algo]
    for name, value in ({"preset": PRESET} | dict(chosen)).items():
        words += [f"--{name}", value]
    context = click.Context(command.main, info_name=command.script)
    context.meta["words"] = words
    return {one.name: one for one in command.main.get_params(context) if isinstance(one, click.Option) and one.name}


def training_command(folder: Path, plan: Plan, job: Job, means: Means) -> CommandLine:
    """Return the command that trains a job to its last step, from where it is.

    Raises:
        UserError: a switch has another value than true or false.
    """
    known, given = training_options(job.algo, plan.on_policy, job.options), {"preset": PRESET} | dict(job.options)
    words = ["--algo", job.algo, "--shards", *plan.shards]
    words += [word for name, value in given.items() for word in _words(known[name], value)]
    words += ["--seed", str(job.seed), "--threads", str(means.threads), "--device", means.device]
    words += ["--out", str(run_folder(folder, job))]
    if not plan.on_policy:
        return CommandLine("grasp-train", (*words, "--steps", str(plan.steps)))
    words += ["--rounds", str(plan.steps // STEPS_PER_ROUND), "--steps-per-round", str(STEPS_PER_ROUND)]
    words += [] if "grasps" in given else ["--grasps", str(GRASPS_PER_ROUND)]
    words += ["--workers", _workers(means)]
    words += ["--objects", plan.objects] if plan.objects is not None else []
    return CommandLine("grasp-online", tuple(words))


def evaluation_command(folder: Path, plan: Plan, job: Job, means: Means) -> CommandLine:
    """Return the command that scores a job's run."""
    words = [str(run_folder(folder, job)), "--split", plan.split, "--episodes", str(plan.episodes)]
    words += ["--seed", str(SCENES_SEED), "--workers", _workers(means), "--device", means.device]
    words += ["--objects", plan.objects] if plan.objects is not None else []
    return CommandLine("grasp-eval", tuple(words))


def _workers(means: Means) -> str:
    """Return how many processes simulate for a job: one is the job's own."""
    return str(means.threads if means.threads > 1 else 0)


def _words(option: click.Option, value: str) -> list[str]:
    """Return what gives an option a value on a command line."""
    if not option.is_flag:
        return [option.opts[0], value]
    if value not in ("true", "false"):
        raise UserError(f"--vary {option.name}: is a switch, expected true or false, got {value!r}")
    return [option.opts[0] if value == "true" else option.secondary_opts[0]]


def next_command(folder: Path, plan: Plan, state: State, means: Means) -> CommandLine | None:
    """Return what a job needs next, or None where it is done."""
    if state.evaluation is not None:
        return None
    command = training_command if state.steps < plan.steps else evaluation_command
    return command(folder, plan, state.job, means)


def check_commands(folder: Path, plan: Plan, jobs: Sequence[Job], means: Means) -> None:
    """Refuse jobs whose commands do not understand an option or its value.

    Raises:
        UserError: see the message; nothing was run.
    """
    for job in jobs:
        for command in (training_command(folder, plan, job, means), evaluation_command(folder, plan, job, means)):
            try:
                context = command.main.make_context(command.script, list(command.arguments))
                _check_values(command.script, given_options(context))
            except click.ClickException as error:
                raise UserError(
                    f"{job.id}: {command.script} cannot run it: {error.format_message()}; nothing was run"
                ) from None


def _check_values(script: str, given: dict[str, Any]) -> None:
    """Refuse values that only the settings themselves can tell."""
    if script == "grasp-train":
        complete({name: value for name, value in given.items() if name != "preset"}, given["preset"])
    elif script == "grasp-online":
        # Imported late: it needs the simulator.
        from graspq.online.resolve import resolve

        resolve(given)


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
    objects = Path(plan.objects) if plan.objects is not None else objects_beside(pool.folders)
    prepare(Evaluation(None, RANDOM, pool.task["name"], plan.split, objects=objects), EvalSettings(policy=(RANDOM,)))
    for job in [] if plan.on_policy else plan.jobs:
        run = run_of(run_folder(folder, job))
        if run is not None and run.config.get("dataset", {}).get("manifest_sha256") != pool.manifest_digest:
            raise UserError(f"{run.folder}: learned from other data than {' '.join(plan.shards)}; choose another --out")


def objects_beside(datasets: Sequence[Path]) -> Path | None:
    """Return the object set that lies in the first dataset that holds one."""
    beside = (folder / "objects" for folder in datasets)
    return next((path for path in beside if (path / SET_FILE).is_file()), None)
