"""SIGKILL at the N-th system call that changes a file, for every N; then the same command again."""

import os
import shutil
import signal
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.faults.harness import CommittedWork, Fault, NotHereError, Ran, Tried, Work
from tests.faults.system_calls import (
    CHANGES,
    FSYNC,
    KILL,
    KILL_HALF,
    MAKES,
    OF_COMMAND,
    RENAME,
    TRAINS,
    WRITE,
    Scenario,
    Stage,
    armed,
    compared,
    difference,
    scenarios,
)

HALVES = 16  # writes of each command that are cut in half, evenly spread


@dataclass
class CrashPoints:
    """Killed before the N-th call, or in the midst of the N-th write."""

    name: str = "SIGKILL at a system call"
    half: bool = False

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return one for every call that changes a file."""
        stage = stage_of(work)
        for scenario in scenarios(work, short, MAKES if self.half else TRAINS):
            count = stage.unbroken(scenario).count(WRITE if self.half else CHANGES)
            numbers = range(1, count + 1)
            for number in few(numbers, 1) if short else few(numbers, HALVES) if self.half else numbers:
                yield Fault(self.name, scenario.command, f"{number}")

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Kill the command and start it again."""
        stage, scenario = stage_of(work), OF_COMMAND[fault.command]
        with stage.begun(scenario) as case:
            what = (
                armed(case, KILL_HALF, int(fault.name), calls=WRITE)
                if self.half
                else armed(case, KILL, int(fault.name))
            )
            killed = work.forked(scenario.argv, case, armed=what)
            if killed.rc != -signal.SIGKILL:
                return not_met(killed)
            return gone_on(scenario, case, work)


@dataclass
class KilledByStrace:
    """The same of some calls, with a process that is started anew and a kernel's tracer that kills it."""

    name: str = "SIGKILL at a system call (strace)"

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return a few for each command; none in the short form."""
        if shutil.which("strace") is None:
            raise NotHereError("no strace here")
        for scenario in scenarios(work, short, None):
            unbroken = stage_of(work).unbroken(scenario)
            for name, calls in (("fsync", FSYNC), ("rename", RENAME)):
                for number in few(range(1, unbroken.count(calls) + 1), 3):
                    yield Fault(self.name, scenario.command, f"{name} {number}")

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Kill the command and start it again."""
        stage, scenario = stage_of(work), OF_COMMAND[fault.command]
        name, number = fault.name.split()
        with stage.begun(scenario) as case:
            tracer = ("strace", "-f", "-qq", "-o", os.devnull, "-e", f"trace={name}")
            what = f"inject={name}:signal=KILL:when={number}"
            killed = work.run(scenario.argv, case, before=(*tracer, "-e", what))
            if killed.rc != -signal.SIGKILL:
                return not_met(killed)
            return gone_on(scenario, case, work)


_STAGES: dict[Work, Stage] = {}


def stage_of(work: Work) -> Stage:
    """Return the stage of a work; all kinds share it."""
    return _STAGES.setdefault(work, Stage(work))


def few(numbers: range, count: int) -> list[int]:
    """Return some numbers, evenly spread."""
    return sorted({numbers[(2 * one + 1) * len(numbers) // (2 * count)] for one in range(count)}) if numbers else []


def not_met(ran: Ran) -> Tried:
    """Judge a command that ended without the fault that it was to meet: nothing is shown by it."""
    return ran.broken() or Tried("silently wrong", f"the fault did not happen, exit status {ran.rc}: {ran.line}")


def gone_on(scenario: Scenario, case: Path, work: Work, more: Sequence[str] = ()) -> Tried:
    """Run the same command again after it was broken off: it must keep what is whole, and end as if it had not been.

    Args:
        scenario: of the command.
        case: its working folder.
        work: runs it.
        more: words besides.
    """
    unbroken = stage_of(work).unbroken(scenario).files
    committed = CommittedWork(case, unbroken)
    again = work.forked([*scenario.argv, *more], case)
    broken = again.broken()
    if broken is not None:
        return broken
    if again.rc != 0:
        return Tried("lost", again.line)
    differs = difference(compared(case), unbroken)
    if differs is not None:
        return Tried("silently wrong", differs)
    left = work.left_over(case)
    return committed.lost() or (Tried("survived") if left is None else Tried("lost", f"{left}: left over"))
