"""Signals that a user, a terminal or a scheduler sends, at any moment; then the same command again."""

import signal
import time
from collections.abc import Iterable
from pathlib import Path

from tests.faults.commands import LINES, TRAIN, Line, Running
from tests.faults.harness import Fault, Ran, Tried, Work

SENT = {
    "Ctrl-C": (signal.SIGINT,),
    "Ctrl-C twice": (signal.SIGINT, signal.SIGINT),
    "Ctrl-C three times": (signal.SIGINT,) * 3,
    "SIGTERM": (signal.SIGTERM,),
    "SIGTERM twice": (signal.SIGTERM,) * 2,
    "SIGHUP": (signal.SIGHUP,),
}
# Seconds after the start: while Python starts, while modules are imported, and after the first thing was written.
MOMENTS = ("importing", "beginning", "working")
BETWEEN = 0.15


class Signals:
    """Signals to a command and all that it has started."""

    name = "signals"

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return each signal to each command at each moment."""
        for line in (TRAIN,) if short else LINES:
            for sent in ("Ctrl-C three times",) if short else SENT:
                for moment in MOMENTS[-1:] if short else MOMENTS:
                    yield Fault(self.name, line.name, f"{sent}, {moment}")

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Send them, wait for the end, and run the command again."""
        line = next(one for one in LINES if one.name == fault.command)
        sent, moment = fault.name.split(", ")
        with line.case(work) as case:
            running = Running(work, line.words, case)
            _wait(running, line, case / line.result, moment)
            for number in SENT[sent]:
                running.send(number)
                time.sleep(BETWEEN)
            broken = _wrong(running.ended())
            return broken if broken is not None else line.goes_on(case, work)


def _wait(running: Running, line: Line, result: Path, moment: str) -> None:
    if moment == "importing":
        # Handlers of signals are there once Python has started; before that, the kernel's default ends the process.
        time.sleep(0.5)
    elif moment == "beginning":
        time.sleep(1.5)
    elif line.result:
        running.until(lambda: result.exists() or any(result.parent.glob(".tmp-*")))
        time.sleep(0.3)


def _wrong(ran: Ran) -> Tried | None:
    if ran.hung:
        return Tried("hung", ran.line)
    if "Traceback" in ran.stderr or "Exception ignored" in ran.stderr:
        return Tried("traceback", ran.line)
    return None


class Suspended:
    """A command that is stopped and goes on, as by Ctrl-Z and `fg`."""

    name = "suspended"

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return each command."""
        for line in () if short else LINES:
            yield Fault(self.name, line.name, "SIGTSTP and SIGCONT")

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Stop it for a second."""
        line = next(one for one in LINES if one.name == fault.command)
        with line.case(work) as case:
            running = Running(work, line.words, case)
            _wait(running, line, case / line.result, "working")
            for number in (signal.SIGSTOP, signal.SIGCONT):
                running.send(number)
                time.sleep(1.0)
            ended = running.ended()
            broken = ended.broken()
            if broken is not None or ended.rc != 0:
                return broken or Tried("lost", ended.line)
            return line.fits(case, work, ended)
