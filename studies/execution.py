"""How the jobs of a sweep are done: units of the engine, each a training and its evaluation, in commands of ours.

Where workers have no disk in common with us (Ray), a run folder travels to them with its job and comes back from them.
"""

import contextlib
import dataclasses
import hashlib
import os
import shutil
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graspq.common.files import cache_folder, committed_folder, read_json, write_json
from graspq.common.options import INTERRUPTED
from graspq.datasets.dataset import open_shards
from graspq.engine import Place
from graspq.engine.shipping import packed, unpack
from graspq.studies.commands import CommandLine, Means, next_command, objects_beside
from graspq.studies.plan import Job, Plan
from graspq.studies.state import log_file, note_failure, run_folder, run_of, state_of, trained_steps

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


@dataclass(frozen=True)
class Task:
    """A job, and with Ray what its run folder holds so far, packed, and the step that it has come to."""

    job: Job
    run: bytes | None = None
    steps: int = 0


@dataclass(frozen=True)
class Failure:
    """Why a job failed: its command, the exit status, and the reason in one line."""

    command: str
    exit_status: int
    reason: str


@dataclass(frozen=True)
class Ending:
    """What a worker says of a job: why it failed, if it did, and with Ray what it made."""

    failure: Failure | None
    run: bytes | None = None
    log: bytes = b""


@dataclass(frozen=True)
class Jobs:
    """How jobs are done; the `Work` of a sweep.

    Attributes:
        folder: of the sweep, absolute.
        plan: the plan.
        means: what each job may use.
        travels: whether run folders travel, and with them what they are made from.
        datasets: folders that the shards lie in.
        shards: each shard as the number of its dataset and its path in there.
    """

    folder: Path
    plan: Plan
    means: Means
    travels: bool
    datasets: tuple[Path, ...]
    shards: tuple[tuple[int, str], ...]

    @classmethod
    def of(cls, folder: Path, plan: Plan, means: Means, *, travels: bool) -> "Jobs":
        """Return the work of a plan.

        Raises:
            UserError: the data are not there.
        """
        paths = dict.fromkeys(ref.path.absolute() for ref in open_shards(plan.shards, verify=False).blocks)
        homes = tuple(dict.fromkeys(path.parent.parent for path in paths))
        shards = tuple((homes.index(path.parent.parent), f"{path.parent.name}/{path.name}") for path in paths)
        return cls(folder.absolute(), plan, means, travels, homes, shards)

    def folders(self) -> Sequence[Path]:
        """Return the datasets and the object set."""
        asked = [Path(self.plan.objects)] if self.plan.objects is not None else []
        return [*self.datasets, *asked] if self.travels else []

    @contextlib.contextmanager
    def open(self, place: Place) -> Iterator[Callable[[Task], Ending]]:
        """Set the number of threads before anything can ask for it."""
        os.environ |= dict.fromkeys(THREAD_VARIABLES, str(self.means.threads))
        yield (lambda task: self._far(task, place)) if self.travels else self._near

    def _near(self, task: Task) -> Ending:
        return Ending(do_job(self.folder, self.plan, task.job, self.means))

    def _far(self, task: Task, place: Place) -> Ending:
        """Do a job in a folder of this machine; one that a killed worker has left here is gone on with."""
        name = hashlib.sha256(str(self.folder).encode()).hexdigest()[:16]
        folder, job = cache_folder("sweeps", f"{name}-{task.job.id}"), task.job
        here = run_folder(folder, job)
        if task.run is not None and task.steps >= trained_steps(run_of(here)):
            with committed_folder(here, replace=True) as temporary:
                unpack(task.run, temporary)
        failure = do_job(folder, self._moved(place), job, self.means)
        _name_shards(here, self.plan.shards)
        log = log_file(folder, job)
        ending = Ending(failure, packed(here) if here.is_dir() else None, log.read_bytes() if log.exists() else b"")
        shutil.rmtree(folder, ignore_errors=True)
        return ending

    def _moved(self, place: Place) -> Plan:
        """Return the plan with this worker's own copies of the data and the object set."""
        datasets = [place(home) for home in self.datasets]
        asked = Path(self.plan.objects) if self.plan.objects is not None else None
        objects = place(asked) if asked is not None else objects_beside(datasets)
        return dataclasses.replace(
            self.plan,
            shards=tuple(str(datasets[number] / path) for number, path in self.shards),
            objects=None if objects is None else str(objects),
        )

    def keep(self, task: Task, ending: Ending) -> None:
        """Put what a worker has made and said into the sweep's folder."""
        if ending.run is not None:
            with committed_folder(run_folder(self.folder, task.job), replace=True) as temporary:
                unpack(ending.run, temporary)
        if ending.log:
            log = log_file(self.folder, task.job)
            log.parent.mkdir(exist_ok=True)
            with log.open("ab") as file:
                file.write(ending.log)
        if ending.failure is not None:
            note_failure(self.folder, task.job, **dataclasses.asdict(ending.failure))

    def tasks(self, jobs: Sequence[Job]) -> Iterator[Task]:
        """Yield the units of some jobs, each packed when a worker is free for it."""
        for job in jobs:
            here = run_folder(self.folder, job)
            if self.travels and here.is_dir():
                yield Task(job, packed(here), trained_steps(run_of(here)))
            else:
                yield Task(job)


def _name_shards(run: Path, shards: Sequence[str]) -> None:
    """Let a run name the data as the sweep does, not as the worker's copies."""
    path = run / "config.json"
    if path.exists():
        config = read_json(path, "training run")
        config["settings"]["shards"] = list(shards)
        write_json(path, config)


def do_job(folder: Path, plan: Plan, job: Job, means: Means) -> Failure | None:
    """Run the commands that a job needs, one after the other, from where it is; return why it failed, if it did.

    Raises:
        KeyboardInterrupt: a command was asked to end; it has kept what it had.
    """
    before: CommandLine | None = None
    while (command := next_command(folder, plan, state_of(folder, plan, job), means)) is not None:
        if command == before:
            return Failure(str(command), 0, f"{command.script} ended without an error and without a result")
        status = _call(command, log_file(folder, job))
        if status == INTERRUPTED:
            raise KeyboardInterrupt
        if status != 0:
            return Failure(str(command), status, _reason(log_file(folder, job), command, status))
        before = command
    return None


def _call(command: CommandLine, log: Path) -> int:
    """Call a command in this process, with its output in a log; return its exit status."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with _output_to(log):
        print(f"$ {command}", flush=True)
        try:
            main: Any = command.main
            main(list(command.arguments), prog_name=command.script)
        except SystemExit as ended:
            return ended.code if isinstance(ended.code, int) else int(bool(ended.code))
        except Exception:
            traceback.print_exc()
            return 1
    return 0


@contextlib.contextmanager
def _output_to(log: Path) -> Iterator[None]:
    """Send what this process writes to both outputs to a file, also what native code writes."""
    kept = [os.dup(number) for number in (1, 2)]
    written = (sys.stdout, sys.stderr)
    with log.open("a", encoding="utf-8", buffering=1) as file:
        for stream in written:
            stream.flush()
        for number in (1, 2):
            os.dup2(file.fileno(), number)
        sys.stdout = sys.stderr = file
        try:
            yield
        finally:
            file.flush()
            sys.stdout, sys.stderr = written
            for number, before in zip((1, 2), kept, strict=True):
                os.dup2(before, number)
                os.close(before)


def _reason(log: Path, command: CommandLine, status: int) -> str:
    """Return why a command failed: the last line that it wrote."""
    lines = [line.strip() for line in log.read_text(errors="replace").replace("\r", "\n").splitlines()]
    last = next((line for line in reversed(lines) if line), "")
    return " ".join(last.removeprefix("error: ").split()) or f"{command.script} ended with status {status}"


def forget_failures(folder: Path, jobs: Sequence[Job]) -> None:
    """Forget that jobs failed, so that they run again."""
    for job in jobs:
        (folder / "failures" / f"{job.id}.json").unlink(missing_ok=True)
