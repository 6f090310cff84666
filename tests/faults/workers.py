"""What happens to a worker process: it is killed, killed again, stopped, or has too little memory."""

import os
import resource
import signal
import tempfile
import threading
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from tests.faults.commands import STUDY, SWEEP, Line, Running, line_of
from tests.faults.harness import MADE, Fault, Ran, Tried, Work

# Blocks and tasks of the usual sizes, and enough of them that a worker is still at work when its fault comes.
MADE["collection"] = (
    "data/regular-60",
    ("grasp-datagen --size 60 --objects objects --out data/regular-60 --seed 0 --workers 0",),
)
MADE["longer evaluation"] = (
    "more-scores",
    ("grasp-eval runs/mc --episodes 40 --films 1 --workers 0 --device cpu --out more-scores",),
)


def with_a_worker(line: Line) -> Line:
    """Return a command with one worker."""
    words = list(line.words)
    words[words.index("--workers") + 1] = "1"
    return replace(line, words=tuple(words))


COLLECT = line_of("collection", "objects")
LINES = {
    line.name: with_a_worker(line) for line in (COLLECT, line_of("longer evaluation", "dataset", "run"), SWEEP, STUDY)
}
FAULTS = (
    "SIGKILL at once", "SIGKILL later", "SIGKILL twice", "SIGSEGV", "SIGTERM", "SIGSTOP for a while",
    "SIGSTOP and Ctrl-C", "too little memory", "the server killed", "the command killed",
    "the command killed, its worker slow", "all killed",
)  # fmt: skip
# Failures are noted in their table, and not tried again unless asked.
NOTING = ("grasp-sweep", "grasp-study")
LEFT_SECONDS = 20.0
# CPU time, as fast machines and slow ones differ: of a worker that has begun, not a child that its server has for a
# moment while it imports, and of one in the midst of its unit.
BEGUN_SECONDS, WORKED_SECONDS = 0.02, 0.3
SLOW_SECONDS = 6.0  # that a worker outlives its command; less than the next start waits for a folder


class Workers:
    """Faults of workers."""

    name = "workers"

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return each fault of the workers of each command; the suite has tests of the engine for them."""
        for name in () if short else LINES:
            for fault in FAULTS:
                yield Fault(self.name, name, fault)

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Do it to the first worker that there is, see how the command ends, and run it again."""
        line = LINES[fault.command]
        work.made("objects")
        # A folder for temporary files of its own, where leftovers are seen; a short name, as sockets need it.
        with line.case(work) as case, tempfile.TemporaryDirectory(prefix="faults-", dir="/tmp") as own:
            temporary, env = Path(own), {"TMPDIR": own}
            running = Running(work, line.words, case, env)
            running.until(lambda: _at_work(running, BEGUN_SECONDS))
            if not _do(fault.name, running, line.name in NOTING):
                running.send(signal.SIGKILL)
                return Tried("silently wrong", f"the fault did not happen: no such process; {running.ended().line}")
            if fault.name.startswith("the command killed"):
                running.process.wait()
                met = line.goes_on(case, work, env)  # while its worker is still ending
                if met.outcome != "survived":
                    running.ended()
                    return met
            ended = running.ended()
            wrong = _wrong(fault.name, ended)
            if wrong is not None:
                return wrong
            if not _alone(running, temporary, fault.name):
                return Tried("lost", f"left in the folder for temporary files: {_names(temporary)}")
            if ended.rc == 1 and line.name in NOTING:
                line = replace(line, words=(*line.words, "--retry-failed"))
            after = line.goes_on(case, work, env) if ended.rc != 0 else line.fits(case, work)
            if after.outcome == "survived" and _names(temporary):
                return Tried("lost", f"never swept: {_names(temporary)}")
            return after if after.outcome != "survived" or ended.rc == 0 else Tried("detected", ended.line)


def _do(what: str, running: Running, trains: bool) -> bool:
    """Do it; return whether there was a process to do it to.

    Args:
        what: the fault.
        running: the command.
        trains: whether its workers train, and hold the lock of what they train.
    """

    def end(number: signal.Signals) -> bool:
        for worker in running.workers()[:1]:
            return _kill(worker, number)
        return False

    match what:
        case "SIGKILL at once":
            return end(signal.SIGKILL)
        case "SIGKILL later":
            return running.until(lambda: _at_work(running)) and end(signal.SIGKILL)
        case "SIGKILL twice":
            seen: set[int] = set()
            while len(seen) < 2 and running.until(lambda: set(running.workers()) - seen):
                time.sleep(0.3)
                for worker in set(running.workers()) - seen:
                    if _kill(worker, signal.SIGKILL):
                        seen.add(worker)
            return len(seen) == 2
        case "SIGSEGV" | "SIGTERM":
            return running.until(lambda: _at_work(running)) and end(signal.Signals[what])
        case "SIGSTOP for a while":
            met = end(signal.SIGSTOP)
            time.sleep(2.0)
            end(signal.SIGCONT)
            return met
        case "SIGSTOP and Ctrl-C":
            met = end(signal.SIGSTOP)
            time.sleep(0.5)
            running.process.send_signal(signal.SIGINT)
            time.sleep(0.5)
            running.process.send_signal(signal.SIGINT)  # the first waits for the worker to keep what it has
            return met
        case "too little memory":
            workers = running.workers()[:1]
            for worker in workers:
                size = int(Path(f"/proc/{worker}/statm").read_text().split()[0]) * resource.getpagesize()
                resource.prlimit(worker, resource.RLIMIT_AS, (size + 2**20, size + 2**20))
            return bool(workers)
        case "the server killed":
            for one in running.descendants():
                if b"forkserver" in Path(f"/proc/{one}/cmdline").read_bytes():
                    _kill(one, signal.SIGKILL)
                    return True
        case "the command killed":
            met = running.until(lambda: _at_work(running))
            running.process.kill()
            return met
        case "the command killed, its worker slow":
            running.until(lambda: any(map(_holds_a_run, running.workers())) if trains else _at_work(running))
            workers = running.workers()
            for worker in workers:
                _kill(worker, signal.SIGSTOP)
            running.process.kill()
            threading.Timer(SLOW_SECONDS, lambda: [_kill(worker, signal.SIGCONT) for worker in workers]).start()
            return bool(workers)
        case "all killed":
            met = running.until(lambda: _at_work(running))
            for one in running.descendants():
                _kill(one, signal.SIGKILL)
            running.process.kill()
            return met
    return False


def _kill(process: int, number: signal.Signals) -> bool:
    """Send a signal; return whether the process was there."""
    try:
        os.kill(process, number)
    except ProcessLookupError:
        return False
    return True


def _at_work(running: Running, seconds: float = WORKED_SECONDS) -> bool:
    """Return whether a worker has spent so much CPU time."""
    return any(_cpu_seconds(worker) >= seconds for worker in running.workers())


def _cpu_seconds(process: int) -> float:
    try:
        stat = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(stat[11]) + int(stat[12])) / os.sysconf("SC_CLK_TCK")


def _holds_a_run(worker: int) -> bool:
    """Return whether a process has the lock of a training."""
    try:
        links = [link.readlink() for link in Path(f"/proc/{worker}/fd").iterdir()]
        return any(path.match("runs/*/.lock") for path in links)
    except OSError:
        return False


def _wrong(what: str, ran: Ran) -> Tried | None:
    if ran.rc == -signal.SIGKILL and what.startswith(("the command killed", "all killed")):
        return None
    broken = ran.broken()
    if broken is not None:
        return broken
    if ran.rc in (0, 130) or ran.one_line or (ran.rc == 1 and ran.line):
        return None
    return Tried("lost", f"exit status {ran.rc}: {ran.line}")


def _alone(running: Running, temporary: Path, what: str) -> bool:
    """Return whether nothing is left of a command soon after its end; a folder of a killed one is swept later."""
    until = time.monotonic() + LEFT_SECONDS
    while time.monotonic() < until:
        if not _names(temporary) or what in ("all killed", "the server killed"):
            return True
        time.sleep(0.1)
    return False


def _names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if not path.name.startswith("torch"))
