"""A study from plan to table: collect what is missing, score the policies beside the rows, train and score the rows.

Every unit is done when its output is there, so that a study that was killed at any moment goes on by the same command.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import click

from graspq.common.errors import UserError
from graspq.common.files import locked, remove_temporaries, writable_folder
from graspq.common.options import INTERRUPTED, parse_count
from graspq.datasets.manifest import MANIFEST_NAME, Manifest
from graspq.engine.plan import Ending, carry_out
from graspq.evaluate.recipe_digest import of_a_recipe
from graspq.evaluate.results_table import TABLE_FILE
from graspq.studies.study.cells import Cell, by_dataset
from graspq.studies.study.freezing import difference, require_frozen
from graspq.studies.study.plan_file import StudyPlan
from graspq.studies.study.scores import NOTHING, Published, reference, write_scores
from graspq.studies.sweep.checks import check_commands, check_data, objects_beside
from graspq.studies.sweep.commands import CommandLine
from graspq.studies.sweep.table import line_of
from graspq.studies.sweep.trial import SCENES_SEED, run_in
from graspq.studies.sweep.workers import hand_out


@dataclass(frozen=True)
class Called:
    """A unit that is a command, called in this process.

    Attributes:
        name: what it is.
        command: the command.
        log: where its output goes.
        there: whether its output is there.
    """

    name: str
    command: CommandLine
    log: Path
    there: Callable[[], bool]

    def done(self) -> bool:
        """Return whether its output is there."""
        return self.there()

    def run(self) -> None:
        """Call the command.

        Raises:
            UserError: it failed.
            KeyboardInterrupt: it was asked to end.
        """
        click.echo(f"{self.name} ...", err=True)
        status, last = self.command.call(self.log)
        if status == INTERRUPTED:
            raise KeyboardInterrupt
        if status != 0:
            raise UserError(f"{self.name}: {last or f'{self.command.script} ended with status {status}'} ({self.log})")


def run_study(
    plan: StudyPlan,
    folder: Path,
    cells: Sequence[Cell],
    *,
    retry_failed: bool = False,
    published: Published = NOTHING,
) -> int:
    """Do what a plan asks for; return the exit status: 0, 1 if a cell failed, 130 if a signal stopped it.

    Args:
        plan: the plan.
        folder: of the study.
        cells: its cells.
        retry_failed: train again what failed.
        published: scores that stand for cells, which are not done again; see `published_scores`.

    Raises:
        UserError: the plan cannot be carried out as it stands; no training was started then.
    """
    require_frozen(plan, cells)
    check_runs(cells)
    wanted = ("to do", "failed") if retry_failed else ("to do",)
    here = [cell for cell in cells if cell.name not in published.runs]
    todo = [cell for cell in here if cell.state().status in wanted]
    check_commands(todo)
    writable_folder(folder, "study")
    with locked(folder, "grasp-study"):
        remove_temporaries(folder)
        for cell in todo:
            cell.failure_note.unlink(missing_ok=True)
        finished = len(cells) - len(todo)
        elsewhere = f", {len(published.runs)} of them published" if published.runs else ""
        click.echo(f"{folder}: {finished} of {len(cells)} trainings finished before{elsewhere}", err=True)

        def report(ending: Ending[Cell]) -> None:
            nonlocal finished
            if not ending.skipped:
                finished += 1
                click.echo(f"[{finished}/{len(cells)}] {line_of(ending.unit.state())}", err=True)
                write_scores(plan, folder, cells, published)

        try:
            carry_out(collections(plan, cells), lambda ending: None, keep_going=False)
            for some in by_dataset(todo).values():
                check_data(some[0].settings, some)
            carry_out(references(plan, cells, published), lambda ending: None, keep_going=False)
            write_scores(plan, folder, cells, published)
            carry_out(here, report, hand_out=hand_out)
        except KeyboardInterrupt:
            click.echo(f"interrupted; the same command goes on with {folder}", err=True)
            return INTERRUPTED
        write_scores(plan, folder, cells, published)
    return int(any(cell.state().status != "done" for cell in here))


def collections(plan: StudyPlan, cells: Sequence[Cell]) -> Iterator[Called]:
    """Yield the units that collect datasets."""
    for (task, size), some in by_dataset(cells).items():
        folder, settings = plan.dataset(task, size), some[0].settings
        words = ["--task", task, "--size", size, "--out", str(folder), "--seed", "0", "--engine", settings.engine]
        words += ["--ray-address", settings.ray_address] if settings.ray_address is not None else []
        yield Called(
            f"collecting {folder}",
            CommandLine("grasp-datagen", tuple(words)),
            settings.folder / "logs" / f"collect-{folder.name}.log",
            partial(_holds, folder, parse_count(size)),
        )


def _holds(folder: Path, count: int) -> bool:
    """Return whether a dataset is there and has all its grasps."""
    return (folder / MANIFEST_NAME).is_file() and Manifest.load(folder).episodes >= count


def references(plan: StudyPlan, cells: Sequence[Cell], published: Published) -> Iterator[Called]:
    """Yield the units that score policies without a run on the scenes of a task, which are those of all its rows.

    What is published is not scored again.
    """
    seen: set[str] = set()
    for (task, size), some in by_dataset(cells).items():
        if task in seen:
            continue
        seen.add(task)
        objects, settings = objects_beside([plan.dataset(task, size)]), some[0].settings
        for policy in plan.values["policies"]:
            if published.reference(policy, task) is not None:
                continue
            words = ["--policy", policy, "--task", task, "--split", plan.split]
            words += ["--episodes", str(settings.episodes), "--seed", str(SCENES_SEED)]
            words += ["--objects", str(objects)] if objects is not None else []
            name = f"{policy.replace(':', '.')}-{task.replace(':', '.')}"
            # A folder each: a table beside says of one policy alone whether its command came to the end.
            words += ["--engine", settings.engine, "--out", str(settings.folder / "references" / name)]
            words += ["--ray-address", settings.ray_address] if settings.ray_address is not None else []
            words += ["--workers", "0"] if settings.workers == 0 else []
            yield Called(
                f"scoring {policy} on {task} {plan.split}",
                CommandLine("grasp-eval", tuple(words)),
                settings.folder / "logs" / f"{name}.log",
                partial(_is_scored, plan, settings.folder, policy, task),
            )


def _is_scored(plan: StudyPlan, folder: Path, policy: str, task: str) -> bool:
    found = reference(plan, folder, policy, task)
    return found is not None and (found.folder.parent / TABLE_FILE).is_file()


def check_runs(cells: Sequence[Cell]) -> None:
    """Refuse runs that are there with other settings than the plan gives them now, as defaults change with the code.

    Raises:
        UserError: there is one.
    """
    for cell in cells:
        run = run_in(cell.run_folder)
        if run is None:
            continue
        there, here = of_a_recipe(run.config["settings"]), cell.deciding["training"]
        if there != here:
            raise UserError(
                f"{cell.run_folder}: {difference(there, here)} when it was trained; delete it, or choose another --out"
            )
