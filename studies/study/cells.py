"""A cell of a study's table, a unit of its plan: one row trained on one dataset with one seed, and scored."""

import contextlib
import functools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from graspq.common.errors import UserError, said_of
from graspq.common.machine import available_cores
from graspq.common.options import given_options, parse_count
from graspq.evaluate.recipe_digest import deciding
from graspq.evaluate.records import identity_digest
from graspq.studies.study.plan_file import Row, StudyPlan
from graspq.studies.sweep.commands import CommandLine, training_options
from graspq.studies.sweep.settings import SweepSettings
from graspq.studies.sweep.trial import Trial
from graspq.train.recipe import Recipe
from graspq.train.settings import complete


@dataclass(frozen=True)
class Cell(Trial):
    """One training and its evaluation; `settings` are those of a trial, here of this cell's row and dataset.

    Attributes:
        row: name of the row.
        task: name of the task.
        size: size of the dataset, as the plan writes it.
        plan: file of the plan.
    """

    row: str
    task: str
    size: str
    plan: Path

    @property
    def name(self) -> str:
        """Row, dataset and seed: `mc-regular-10k-seed0`."""
        parts = (self.row, self.task, self.size, f"seed{self.seed}")
        return "-".join(re.sub(r"[^A-Za-z0-9._+-]+", ".", part) for part in parts)

    def training_command(self) -> CommandLine:
        """Return the command that trains to the last step, from where it is.

        Raises:
            UserError: the row has no such option.
        """
        known = training_options(self.algo, self.settings.on_policy, self.options)
        with self._said_of_row():
            for name, _ in self.options:
                if name not in known:
                    raise UserError(f"no option {name} of training with {self.algo}; see grasp-train --help")
            return super().training_command()

    def _said_of_row(self) -> contextlib.AbstractContextManager[None]:
        return said_of(f"{self.plan}, row {self.row}")

    @functools.cached_property
    def deciding(self) -> dict[str, Any]:
        """What decides what is learned and how it acts, but for data and seed, as JSON.

        Raises:
            UserError: the row has no such option, or a value is out of range.
        """
        with self._said_of_row():
            return self._deciding()

    def _deciding(self) -> dict[str, Any]:
        command = self.training_command()
        try:
            context = command.main.make_context(command.script, list(command.arguments))
        except click.UsageError as error:  # it tells of a command line, which nobody has typed
            raise UserError(error.format_message()) from None
        given = given_options(context)
        if self.settings.on_policy:
            # Imported late: it needs the simulator.
            from graspq.studies.online.resolve import resolve

            plan = resolve(given)
            return deciding(plan.train.to_json(), self.settings.cem, plan.described())
        training = complete({name: value for name, value in given.items() if name != "preset"}, given["preset"])
        return deciding(training.to_json(), self.settings.cem)

    @property
    def digest(self) -> str:
        """SHA-256 of `deciding`, which stands beside the score."""
        return identity_digest(self.deciding)


def cells_of(plan: StudyPlan, folder: Path, *, workers: int | None = None, device: str = "auto") -> list[Cell]:
    """Return the cells of a plan in the order in which they are done.

    Seed by seed, so that a study that is stopped has whole columns; of one seed the longest trainings first, else in
    the plan's order.

    Args:
        plan: the plan.
        folder: of the study.
        workers: how many trainings run at a time; the plan's number, else one a core, where not given.
        device: where networks run.
    """
    columns = [(row, task, size) for task in plan.values["tasks"] for size in plan.sizes for row in plan.rows]
    columns.sort(key=lambda column: -_steps(column[0], column[2]))
    found = []
    for seed in range(plan.values["seeds"]):
        for row, task, size in columns:
            with said_of(plan.path):
                settings = _settings(plan, folder, row, task, size, workers, device)
            found.append(Cell(settings, row.algo, row.options, seed, row.name, task, size, plan.path))
    return found


def _settings(
    plan: StudyPlan, folder: Path, row: Row, task: str, size: str, workers: int | None, device: str
) -> SweepSettings:
    values, threads = plan.values, plan.values["threads"]
    asked = workers if workers is not None else values["workers"]
    local = values["engine"] == "local"
    return SweepSettings(
        preset="paper" if plan.on_policy else "small",
        shards=(str(plan.dataset(task, size)),),
        split=plan.split,
        seeds=values["seeds"],
        steps=_steps(row, size),
        episodes=values["episodes"],
        device=device,  # type: ignore[arg-type]
        engine=values["engine"],
        ray_address=values["ray_address"],
        workers=asked if asked is not None or not local else max(available_cores() // threads, 1),
        threads=threads,
        out=folder,
        **plan.search,
    ).complete()


def _steps(row: Row, size: str) -> int:
    if row.steps is not None:
        return row.steps
    batch_size = int(dict(row.options).get("batch_size", Recipe.batch_size))
    return Recipe(batch_size=batch_size).for_grasps(parse_count(size)).last_step


def by_dataset(cells: Sequence[Cell]) -> dict[tuple[str, str], list[Cell]]:
    """Return the cells by task and size."""
    found: dict[tuple[str, str], list[Cell]] = {}
    for cell in cells:
        found.setdefault((cell.task, cell.size), []).append(cell)
    return found
