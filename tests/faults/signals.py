"""Signals that a user, a terminal or a scheduler sends, at any moment; then the same command again."""

import signal
import time
from collections.abc import Iterable
from dataclasses import replace
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
LATER = (0.3, 0.0)  # seconds after the first sign of work; less where a command had ended by then


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
        for later in LATER:
            with line.case(work) as case:
                running = Running(work, line.words, case)
                _wait(running, line, case, moment, later)
                met = running.process.poll() is None
                for number in SENT[sent]:
                    running.send(number)
                    time.sleep(BETWEEN)
                broken = _wrong(running.ended(), SENT[sent])
                if broken is not None:
                    return broken
                after = line.goes_on(case, work)
            if met or after.outcome != "survived":
                return after
        return replace(after, said="had ended before the signal came")


def _wait(running: Running, line: Line, case: Path, moment: str, later: float) -> None:
    result = case / (line.result or "none")
    if moment == "importing":
        # Handlers of signals are there once Python has started; before that, the kernel's default ends the process.
        time.sleep(0.5)
    elif moment == "beginning":
        time.sleep(1.5)
    else:
        running.until(lambda: result.exists() or any(result.parent.glob(".tmp-*")) or running.has_open(case))
        time.sleep(later)


def _wrong(ran: Ran, sent: tuple[signal.Signals, ...]) -> Tried | None:
    """Return what is wrong with the end of a command that got signals: it may have ended before, or by them."""
    if ran.hung:
        return Tried("hung", ran.line)
    if "Traceback" in ran.stderr or "Exception ignored" in ran.stderr:
        return Tried("traceback", ran.line)
    if ran.rc in (0, 130) or -ran.rc in sent or ran.rc - 128 in sent:
        return None
    return Tried("silently wrong", f"exit status {ran.rc}: {ran.line}")


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
            _wait(running, line, case, "working", LATER[0])
            for number in (signal.SIGSTOP, signal.SIGCONT):
                running.send(number)
                time.sleep(1.0)
            ended = running.ended()
            broken = ended.broken()
            if broken is not None or ended.rc != 0:
                return broken or Tried("lost", ended.line)
            return line.fits(case, work, ended)
