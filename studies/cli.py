"""`grasp-sweep`: trains and scores every point of a grid, some at a time, and writes one table.

The way on: `grid` (what is tried) -> `plan` (the jobs) -> `execution` (units of the engine) -> `state` -> `table`.
"""

import contextlib
import dataclasses
from collections import Counter
from pathlib import Path

import click

from graspq.common.files import locked, remove_temporaries, writable_folder
from graspq.common.machine import available_cores
from graspq.common.options import INTERRUPTED, Command, options_from, with_version
from graspq.engine import LostUnitsError, run
from graspq.studies.plan import Plan, joined, read_plan
from graspq.studies.settings import SweepSettings


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
    from graspq.studies.grid import make_plan

    asked = make_plan(settings)
    folder = settings.folder
    plan = joined(read_plan(folder), asked, folder)
    for note in plan.notes:
        click.echo(note, err=True)
    if settings.dry_run:
        click.echo(plan_text(folder, asked))
        return 0
    return _run(settings, folder, plan, asked)


def plan_text(folder: Path, plan: Plan) -> str:
    """Return a plan for the terminal: its jobs with how far each is, the commands of the first, and counts."""
    from graspq.studies.commands import Means, evaluation_command, training_command
    from graspq.studies.state import state_of

    states = [state_of(folder, plan, job) for job in plan.jobs]
    width = max(len(job.id) for job in plan.jobs)
    lines = [f"{state.job.id.ljust(width)}  {state.status}" for state in states]
    first, means = plan.jobs[0], Means(1)
    lines += ["", "The first job's commands:"]
    lines += [f"  {make(folder, plan, first, means)}" for make in (training_command, evaluation_command)]
    algorithms = Counter(job.algo for job in plan.jobs)
    counts = ", ".join(f"{count} {algo}" for algo, count in algorithms.items())
    done = sum(state.status == "done" for state in states)
    lines += [
        "",
        f"{len(plan.jobs)} jobs ({counts}) of {plan.steps:,} steps and {plan.episodes:,} grasps each, {done} done: "
        f"{len(plan.jobs) * plan.steps:,} training steps in all, in {folder}",
    ]
    return "\n".join(lines)


def _run(settings: SweepSettings, folder: Path, plan: Plan, asked: Plan) -> int:
    from graspq.studies.commands import Means, check_commands, check_data
    from graspq.studies.execution import Ending, Failure, Jobs, Task, forget_failures
    from graspq.studies.plan import write_plan
    from graspq.studies.state import state_of
    from graspq.studies.table import as_markdown, line_of, write_tables

    engine = settings.where
    if engine.engine == "local" and engine.workers is None:
        engine = dataclasses.replace(engine, workers=1)
    at_a_time = max(engine.workers or 1, 1)
    threads = settings.threads or (max(available_cores() // at_a_time, 1) if engine.engine == "local" else 1)
    means = Means(threads, settings.device)
    wanted = ("to do", "failed") if settings.retry_failed else ("to do",)
    todo = [job for job in asked.jobs if state_of(folder, plan, job).status in wanted]
    if todo:
        check_commands(folder, plan, todo, means)
        check_data(folder, plan)
    writable_folder(folder, "sweep")
    with locked(folder, "grasp-sweep"):
        remove_temporaries(folder)
        forget_failures(folder, todo)
        states = {job: state_of(folder, plan, job) for job in plan.jobs}
        write_plan(folder, plan)
        write_tables(folder, plan, list(states.values()))
        finished = len(asked.jobs) - len(todo)
        click.echo(f"{folder}: {finished} of {len(asked.jobs)} jobs finished before", err=True)

        def note(task: Task, ending: Ending) -> None:
            nonlocal finished
            finished += 1
            jobs.keep(task, ending)
            states[task.job] = state = state_of(folder, plan, task.job)
            write_tables(folder, plan, list(states.values()))
            click.echo(f"[{finished}/{len(asked.jobs)}] {line_of(state)}", err=True)

        if todo:
            jobs = Jobs.of(folder, plan, means, travels=engine.engine == "ray" and engine.workers != 0)
            # Each job has a process of its own: what the one before it left in memory does not matter.
            endings = run(
                jobs, jobs.tasks(todo), engine, name=lambda task: task.job.id, units_per_worker=1,
                cpus_per_worker=threads,
            )  # fmt: skip
            try:
                with contextlib.closing(endings) as ended:
                    for task, ending in ended:
                        note(task, ending)
            except KeyboardInterrupt:
                click.echo(f"interrupted; the same command goes on with {folder}", err=True)
                return INTERRUPTED
            except LostUnitsError as error:
                for task, how in error.lost:
                    note(task, Ending(Failure("", 1, f"ended its worker twice ({how})")))
    click.echo(as_markdown(plan, list(states.values())), nl=False)
    click.echo(f"table: {folder / 'sweep.csv'}; figure: grasp-report {folder} --out {folder / 'report.html'}", err=True)
    return int(any(states[job].status != "done" for job in asked.jobs))
