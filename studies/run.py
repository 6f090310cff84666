"""The running of a sweep: n jobs at a time, each command a process of its own that ends when the sweep does.

One thread starts and watches them all; what a job needs next is asked of its files after each command.
"""

import contextlib
import ctypes
import fcntl
import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from graspq.common.errors import UserError
from graspq.common.options import INTERRUPTED
from graspq.studies.commands import CommandLine, Means, next_command
from graspq.studies.plan import Job, Plan
from graspq.studies.state import State, failure_file, log_file, note_failure, state_of
from graspq.train.interruption import Interruption

POLL_SECONDS = 0.1
GRACE_SECONDS = 60.0
LOCK_SECONDS = 10.0
STOPPED = (INTERRUPTED, -signal.SIGINT, -signal.SIGTERM, -signal.SIGHUP)
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
PR_SET_PDEATHSIG = 1


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[int]:
    """Hold the sweep's folder for this process and the commands that it starts; yield the lock's descriptor.

    The commands inherit the descriptor: as long as one of a killed sweep lives, the folder is not free.

    Raises:
        UserError: another sweep works here.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("w") as file:
        until = time.monotonic() + LOCK_SECONDS
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except OSError:
                if time.monotonic() > until:
                    raise UserError(f"{folder}: another grasp-sweep works here; wait for it, or use --out") from None
                time.sleep(POLL_SECONDS)
        yield file.fileno()


@dataclass
class _Running:
    """A command at work."""

    job: Job
    command: CommandLine
    process: "subprocess.Popen[bytes]"


@dataclass
class Crew:
    """Runs jobs of a sweep.

    Attributes:
        folder: of the sweep.
        plan: the plan.
        means: what each job may use.
        lock: descriptor of the folder's lock, see `locked`.
        on_finished: called with the state of each job whose last command ended.
    """

    folder: Path
    plan: Plan
    means: Means
    lock: int
    on_finished: Callable[[State], None]

    def run(self, jobs: Sequence[Job], at_a_time: int) -> bool:
        """Run jobs to their end, done or failed, in this order; return False if a signal stopped them before."""
        waiting, running = deque(jobs), list[_Running]()
        with Interruption() as interruption:
            try:
                while (waiting or running) and not interruption.requested:
                    while waiting and len(running) < at_a_time:
                        running += self._next(waiting.popleft(), None)
                    time.sleep(POLL_SECONDS)
                    ended = [one for one in running if one.process.poll() is not None]
                    if not interruption.requested:
                        running = [one for one in running if one not in ended]
                        running += [following for one in ended for following in self._after(one)]
            finally:
                _stop(running)
        return not interruption.requested

    def _after(self, one: _Running) -> list[_Running]:
        """Note a failure, or start the job's next command; return what was started."""
        status = one.process.returncode
        if status == 0:
            return self._next(one.job, one.command)
        if status not in STOPPED:
            reason = _reason(log_file(self.folder, one.job), one.command, status)
            note_failure(self.folder, one.job, str(one.command), status, reason)
        return self._finished(one.job)

    def _next(self, job: Job, before: CommandLine | None) -> list[_Running]:
        """Start what a job needs after its command `before`; return it, or nothing where the job is at its end."""
        command = next_command(self.folder, self.plan, state_of(self.folder, self.plan, job), self.means)
        if command is not None and command == before:
            reason = f"{command.script} ended without an error and without a result"
            note_failure(self.folder, job, str(command), 0, reason)
        if command is None or command == before:
            return self._finished(job)
        return [_Running(job, command, self._start(job, command))]

    def _finished(self, job: Job) -> list[_Running]:
        self.on_finished(state_of(self.folder, self.plan, job))
        return []

    def _start(self, job: Job, command: CommandLine) -> "subprocess.Popen[bytes]":
        environment = os.environ | dict.fromkeys(THREAD_VARIABLES, str(self.means.threads))
        path = log_file(self.folder, job)
        path.parent.mkdir(exist_ok=True)
        with path.open("ab") as log:
            log.write(f"$ {command}\n".encode())
            log.flush()
            return subprocess.Popen(
                command.words,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environment,
                pass_fds=(self.lock,),
                # A terminal's Ctrl-C reaches the sweep alone, which then asks each command once.
                start_new_session=True,
                preexec_fn=_end_with_parent(os.getpid()),
            )


def _reason(log: Path, command: CommandLine, status: int) -> str:
    """Return why a command failed: the last line that it wrote, or the signal that ended it."""
    if status < 0:
        return f"{command.script} was ended by {signal.Signals(-status).name}"
    lines = [line.strip() for line in log.read_text(errors="replace").replace("\r", "\n").splitlines()]
    last = next((line for line in reversed(lines) if line), "")
    return " ".join(last.removeprefix("error: ").split()) or f"{command.script} ended with status {status}"


def _stop(running: Sequence[_Running]) -> None:
    """Ask the commands to end, which keeps what they have; after a while or a second signal, kill them."""
    for one in running:
        _signal(one, signal.SIGTERM)
    until = time.monotonic() + GRACE_SECONDS
    try:
        while time.monotonic() < until and any(one.process.poll() is None for one in running):
            time.sleep(POLL_SECONDS)
    finally:
        for one in running:
            _signal(one, signal.SIGKILL)
            one.process.wait()


def _signal(one: _Running, number: signal.Signals) -> None:
    if one.process.poll() is None:
        one.process.send_signal(number)


def _end_with_parent(parent: int) -> Callable[[], None] | None:
    """Return what a new process calls on Linux so that it dies with a sweep that is killed; None elsewhere."""
    if not sys.platform.startswith("linux"):
        return None
    library = ctypes.CDLL(None)

    def call() -> None:
        library.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # the sweep died before the line above
            os._exit(1)

    return call


def forget_failures(folder: Path, jobs: Sequence[Job]) -> None:
    """Forget that jobs failed, so that they run again."""
    for job in jobs:
        failure_file(folder, job).unlink(missing_ok=True)
