"""`grasp-sweep`: trains and scores every point of a grid, some at a time, and writes one table.

The way on: `grid` (what is tried) -> `trial` (a unit of the plan) -> `workers` (where it is done) -> `table`.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from graspq.common.checksums import write_checked_json
from graspq.common.files import locked, remove_temporaries, writable_folder
from graspq.common.options import INTERRUPTED, Command, options_from, with_version
from graspq.engine.plan import PLAN_FILE, Ending, carry_out, older_units
from graspq.studies.sweep.settings import SweepSettings

if TYPE_CHECKING:
    from graspq.studies.sweep.trial import Trial

FORMAT_VERSION = 2
# What all trials of a folder share, or they would not stand in one table.
FIXED = ("preset", "on_policy", "split", "steps", "episodes")


@click.command(cls=Command, name="grasp-sweep")
@with_version
@options_from(SweepSettings)
def main(settings: SweepSettings) -> int:
    """Train and score a grid of settings; one table comes of it, and `grasp-report FOLDER` draws it.

    All runs train with `--preset paper` of the training command, unless --vary says otherwise. Killed and started
    again, it goes on where it was; what is done is not done again, and the same folder takes more estimators, seeds or
    values later. A job that fails is noted in the table with its reason, and does not stop the others.

    \b
    Examples:
      grasp-sweep --algo dql ddpg --steps 2000 --workers 2
      grasp-sweep --algo corr-mc --vary anneal=0.1,1 --learning-rate 0.001 --width 32
      grasp-sweep --preset paper --dry-run
      grasp-report runs/sweep-small --out sweep.html
    """
    return sweep(settings)


def sweep(settings: SweepSettings) -> int:
    """Run what the settings plan; return the exit status: 0, 1 if a job failed, 130 if a signal stopped it.

    Raises:
        UserError: the plan cannot be made, or what it needs is not there; nothing was run then.
    """
    from graspq.studies.sweep.grid import notes_on, trials_of
    from graspq.studies.sweep.trial import Trial

    whole, folder, notes = settings.complete(), settings.folder, notes_on(settings)
    asked = trials_of(whole)
    shared = described(whole) | {"notes": notes}
    older = older_units(folder, "sweep", shared, FIXED, lambda values: Trial.from_json(whole, values))
    for note in notes:
        click.echo(note, err=True)
    if settings.dry_run:
        click.echo(plan_text(folder, asked))
        return 0
    return _run(whole, folder, shared, asked, [*asked, *(trial for trial in older if trial not in asked)])


def described(settings: SweepSettings) -> dict[str, Any]:
    """Return what `plan.json` says of complete settings."""
    names = ("preset", "on_policy", "shards", "objects", "split", "steps", "episodes")
    values = settings.to_json() | {"on_policy": settings.on_policy}
    return {"format_version": FORMAT_VERSION} | {name: values[name] for name in names}


def plan_text(folder: Path, trials: Sequence["Trial"]) -> str:
    """Return a plan for the terminal: its jobs with how far each is, the commands of the first, and counts."""
    statuses = {trial.name: trial.state().status for trial in trials}
    width = max(map(len, statuses))
    first, settings = trials[0], trials[0].settings
    counts = ", ".join(f"{count} {algo}" for algo, count in Counter(trial.algo for trial in trials).items())
    done, steps = list(statuses.values()).count("done"), settings.steps or 0
    lines = [f"{name.ljust(width)}  {status}" for name, status in statuses.items()]
    lines += ["", "The first job's commands:", f"  {first.training_command()}", f"  {first.evaluation_command()}", ""]
    lines.append(
        f"{len(trials)} jobs ({counts}) of {steps:,} steps and {settings.episodes:,} grasps each, {done} done: "
        f"{len(trials) * steps:,} training steps in all, in {folder}"
    )
    return "\n".join(lines)


def _run(
    settings: SweepSettings, folder: Path, shared: dict[str, Any], asked: Sequence["Trial"], plan: Sequence["Trial"]
) -> int:
    """Do what is asked of a plan; see `sweep`."""
    from graspq.evaluate.over_seeds import lines_over_seeds, over_seeds
    from graspq.studies.sweep.checks import check_commands, check_data
    from graspq.studies.sweep.table import as_markdown, line_of, write_tables
    from graspq.studies.sweep.workers import hand_out

    wanted = ("to do", "failed") if settings.retry_failed else ("to do",)
    todo = [trial for trial in asked if trial.state().status in wanted]
    if todo:
        check_commands(todo)
        check_data(settings, plan)
    writable_folder(folder, "sweep")
    with locked(folder, "grasp-sweep"):
        remove_temporaries(folder)
        for trial in todo:
            trial.failure_note.unlink(missing_ok=True)
        states = {trial.name: trial.state() for trial in plan}
        write_checked_json(folder / PLAN_FILE, shared | {"jobs": [trial.to_json() for trial in plan]})
        write_tables(folder, list(states.values()))
        finished = len(asked) - len(todo)
        click.echo(f"{folder}: {finished} of {len(asked)} jobs finished before", err=True)

        def report(ending: Ending["Trial"]) -> None:
            nonlocal finished
            if not ending.skipped:
                finished += 1
                states[ending.unit.name] = state = ending.unit.state()
                write_tables(folder, list(states.values()))
                click.echo(f"[{finished}/{len(asked)}] {line_of(state)}", err=True)

        try:
            carry_out(asked, report, hand_out=hand_out)
        except KeyboardInterrupt:
            click.echo(f"interrupted; the same command goes on with {folder}", err=True)
            return INTERRUPTED
    click.echo(as_markdown(list(states.values())), nl=False)
    means = lines_over_seeds(over_seeds([one.evaluation for one in states.values() if one.evaluation is not None]))
    if means:
        click.echo(f"\n{means}")
    click.echo(f"table: {folder / 'sweep.csv'}; figure: grasp-report {folder} --out {folder / 'report.html'}", err=True)
    return int(any(states[trial.name].status != "done" for trial in asked))
