"""`grasp-study`: trains and scores every row of a plan, with several seeds, and says what the scores show.

The way on: `plan_file` (what is asked) -> `cells` (units of the plan) -> `study` (where they are done) -> `scores`.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from graspq.common.options import INTERRUPTED, Group, Settings, options_from, setting, with_version

if TYPE_CHECKING:
    from collections.abc import Sequence

    from graspq.studies.study.cells import Cell
    from graspq.studies.study.plan_file import StudyPlan
    from graspq.studies.study.scores import Published


@dataclass(frozen=True)
class PlanSettings(Settings):
    """Options of every part of `grasp-study`."""

    plan: Path = setting(help="The plan, a TOML file such as studies/plans/10k.toml.", positional=True, metavar="PLAN")
    out: Path | None = setting(None, help="Folder of the study; runs/study-PLAN where it is not given.")

    @property
    def folder(self) -> Path:
        """The study's folder: `out`, or its default."""
        return self.out if self.out is not None else Path("runs") / f"study-{self.plan.stem}"


@dataclass(frozen=True)
class PublishSettings(PlanSettings):
    """Options of `grasp-study report`."""

    beside: tuple[Path, ...] = setting(
        (), help="Scores of other studies, such as results/study-paper.jsonl, to judge claims by too. May be repeated."
    )
    results: Path = setting(Path("results"), help="Folder for scores and figures.")
    page: Path = setting(Path("RESULTS.md"), help="Page that gets a section on the study.")
    keep_published: bool = setting(
        False,
        help="Keep what --results holds of this very recipe and these data, and do not do it again: a study goes on in "
        "another clone, or on another machine.",
    )


@dataclass(frozen=True)
class RunSettings(PublishSettings):
    """Options of `grasp-study run`."""

    workers: int | None = setting(
        None,
        help="How many trainings run at a time, each in one thread unless the plan says otherwise. Default: the plan's "
        "number, else one a core; 0 runs them in this process.",
        minimum=0,
    )
    device: Literal["auto", "cpu", "cuda"] = setting("auto", help="Where networks run.")
    retry_failed: bool = setting(False, help="Train again what failed.")
    dry_run: bool = setting(False, help="Print the plan and stop; nothing is written.")


@click.group(cls=Group)
@with_version
def main() -> None:
    """Compare estimators: a plan of many trainings, carried out, scored and judged.

    \b
    Choose settings on validation, freeze them, and only then open test:
      grasp-study run studies/plans/choose.toml
      grasp-study freeze studies/plans/10k.toml
      grasp-study run studies/plans/10k.toml
    """


@main.command("run")
@options_from(RunSettings)
def run(settings: RunSettings) -> int:
    """Carry a plan out: collect what is missing, train and score every row with every seed.

    Killed and started again, it goes on where it was; what is done is not done again. A training that fails is noted
    and stops none of the others. Seeds are done one after the other, so that a study that is stopped has whole columns.
    """
    from graspq.studies.study.study import run_study

    plan, cells = _plan(settings, settings.workers, settings.device)
    published = _published(settings, plan, cells)
    if settings.dry_run:
        click.echo(plan_text(settings.folder, cells, published))
        return 0
    status = run_study(plan, settings.folder, cells, retry_failed=settings.retry_failed, published=published)
    if status != INTERRUPTED and any(cell.name in published.runs or cell.state().status == "done" for cell in cells):
        _publish(settings)
    return status


@main.command("freeze")
@options_from(PlanSettings)
def freeze(settings: PlanSettings) -> None:
    """Write down the settings of every row that decide what is learned, with their digests; test then opens.

    The file is results/recipe-PLAN.json, or what the plan calls its recipe. A recipe is frozen once.
    """
    from graspq.studies.study.freezing import freeze as write_recipe
    from graspq.studies.study.freezing import read_recipe

    plan, cells = _plan(settings)
    path = write_recipe(plan, cells)
    recipe = read_recipe(path)
    for name, row in recipe["rows"].items():
        click.echo(f"{row['digest'][:12]}  {name}")
    click.echo(f"{path}: {len(recipe['rows'])} rows, digest {recipe['digest'][:12]}")


@main.command("report")
@options_from(PublishSettings)
def report(settings: PublishSettings) -> None:
    """Publish the scores so far: tables and a verdict on each claim of the paper in RESULTS.md, figures, all outcomes.

    `grasp-study run` does this at its end. Where the runs are not here, the scores in results/ are judged again.
    """
    _publish(settings)


def _publish(settings: PublishSettings) -> None:
    from graspq.studies.study.publishing import publish
    from graspq.studies.study.scores import read_scores, write_scores

    plan, cells = _plan(settings)
    published = _published(settings, plan, cells)
    here = settings.folder.is_dir()
    table = write_scores(plan, settings.folder, cells, published) if here else read_scores([scores_of(settings, plan)])
    beside, reference = read_scores(settings.beside), plan.values["reference"]
    written = publish(plan.name, plan.path, table, beside, settings.results, settings.page, reference)
    click.echo(f"wrote {', '.join(path.as_posix() for path in written)}")


def scores_of(settings: PublishSettings, plan: "StudyPlan") -> Path:
    """Return the file in which a plan's scores are published."""
    return settings.results / f"study-{plan.name}.jsonl"


def _published(settings: PublishSettings, plan: "StudyPlan", cells: "Sequence[Cell]") -> "Published":
    from graspq.studies.study.scores import NOTHING, published_scores

    return published_scores(plan, cells, scores_of(settings, plan)) if settings.keep_published else NOTHING


def _plan(settings: PlanSettings, workers: int | None = None, device: str = "auto") -> "tuple[StudyPlan, list[Cell]]":
    from graspq.studies.study.cells import cells_of
    from graspq.studies.study.plan_file import read_plan

    plan = read_plan(settings.plan)
    return plan, cells_of(plan, settings.folder, workers=workers, device=device)


def plan_text(folder: Path, cells: "Sequence[Cell]", published: "Published") -> str:
    """Return a plan for the terminal: its trainings in order, how far each is, and the commands of the first to do."""
    statuses = {cell.name: "published" if cell.name in published.runs else cell.state().status for cell in cells}
    first = next((cell for cell in cells if statuses[cell.name] == "to do"), cells[0])
    width = max(map(len, statuses))
    lines = [f"{cell.digest[:12]}  {cell.name.ljust(width)}  {statuses[cell.name]}" for cell in cells]
    steps = sum(cell.settings.steps or 0 for cell in cells)
    lines += [
        "",
        f"The commands of {first.name}:",
        f"  {first.training_command()}",
        f"  {first.evaluation_command()}",
        "",
    ]
    done = sum(one in ("done", "published") for one in statuses.values())
    elsewhere = f", {len(published.runs)} of them published" if published.runs else ""
    lines.append(f"{len(cells)} trainings, {done} done{elsewhere}, {steps:,} steps in all, in {folder}")
    return "\n".join(lines)
