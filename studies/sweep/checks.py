"""What is checked before the first trial of a sweep starts: commands, data and scenes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from graspq.common.errors import UserError
from graspq.common.options import given_options
from graspq.datasets.dataset import open_shards
from graspq.evaluate.scenes import SET_FILE
from graspq.studies.sweep.settings import SweepSettings
from graspq.studies.sweep.trial import Trial, run_in
from graspq.train.settings import complete


def check_commands(trials: Sequence[Trial]) -> None:
    """Refuse trials whose commands do not understand an option or its value.

    Raises:
        UserError: see the message; nothing was run.
    """
    for trial in trials:
        for command in (trial.training_command(), trial.evaluation_command()):
            try:
                context = command.main.make_context(command.script, list(command.arguments))
                _check_values(command.script, given_options(context))
            except click.ClickException as error:
                raise UserError(
                    f"{trial.name}: {command.script} cannot run it: {error.format_message()}; nothing was run"
                ) from None


def _check_values(script: str, given: dict[str, Any]) -> None:
    """Refuse values that only the settings themselves can tell."""
    if script == "grasp-train":
        complete({name: value for name, value in given.items() if name != "preset"}, given["preset"])
    elif script == "grasp-online":
        # Imported late: it needs the simulator.
        from graspq.studies.online.resolve import resolve

        resolve(given)


def check_data(settings: SweepSettings, trials: Sequence[Trial]) -> None:
    """Refuse data or scenes that are not there, and runs that learned from other data.

    Raises:
        UserError: the data, the simulator, the object set or its split is missing, or the data are others than before.
    """
    from graspq.evaluate.evaluation import prepare
    from graspq.evaluate.jobs import Job
    from graspq.evaluate.records import RANDOM
    from graspq.evaluate.settings import EvalSettings

    pool = open_shards(settings.shards, verify=False)
    objects = settings.objects if settings.objects is not None else objects_beside(pool.folders)
    prepare(Job(None, RANDOM, pool.task["name"], settings.split, objects=objects), EvalSettings(policy=(RANDOM,)))
    for trial in [] if settings.on_policy else trials:
        run = run_in(trial.run_folder)
        if run is not None and run.config.get("dataset", {}).get("manifest_sha256") != pool.manifest_digest:
            there = " ".join(settings.shards)
            raise UserError(f"{run.folder}: learned from other data than {there}; choose another --out")


def objects_beside(datasets: Sequence[Path]) -> Path | None:
    """Return the object set that lies in the first dataset that holds one."""
    beside = (folder / "objects" for folder in datasets)
    return next((path for path in beside if (path / SET_FILE).is_file()), None)
