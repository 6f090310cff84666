"""System calls that fail, a full disk, a folder that cannot be written to, and limits of files and memory.

The command must say so in one line that names a file or folder of its own, and go on once there is room.
"""

import errno
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from graspq.common.files import TEMPORARY_PREFIX
from tests.faults.crash_points import few, gone_on, not_met, stage_of
from tests.faults.harness import Fault, NotHereError, Ran, Tried, Work
from tests.faults.system_calls import (
    CREATE,
    FAIL,
    FAIL_FILE,
    FAIL_ON,
    FSYNC,
    MAKES,
    MKDIR,
    OF_COMMAND,
    OPEN,
    READ,
    RENAME,
    WRITE,
    Call,
    Scenario,
    armed,
    compared,
    difference,
    scenarios,
)

NO_MEMORY = "not enough memory"  # of which no file is the cause
MOST = 12  # of each kind and command, evenly spread; more where they would miss a file
IN_SHORT = ("EIO in write", "ENOSPC in open")  # the kinds that `make test` tries


NAMED = re.compile(r"(?<![\w-])(new(-results)?[/:]|data/regular-24|runs/mc|objects/|page\.md|plan\.toml|recipe\.json)")


def judged(ran: Ran, scenario: Scenario, case: Path, work: Work) -> Tried:
    """Judge a command that met a failure, and the same command after it."""
    broken = ran.broken()
    if broken is not None:
        return broken
    if ran.rc == 0:
        # What it could not remove the next start removes, which is looked at by `gone_on`.
        found = {name: one for name, one in compared(case).items() if TEMPORARY_PREFIX not in name}
        differs = difference(found, stage_of(work).unbroken(scenario).files)
        return gone_on(scenario, case, work) if differs is None else Tried("silently wrong", differs)
    if not ran.one_line:
        return Tried("silently wrong", f"exit status {ran.rc}, not one line: {ran.stderr[-300:]}")
    if not NAMED.search(ran.line) and not any(name in ran.line for name in (str(case), NO_MEMORY)):
        return Tried("silently wrong", f"names no file: {ran.line}")
    after = gone_on(scenario, case, work)
    return Tried("detected", ran.line) if after.outcome == "survived" else after


@dataclass
class FailingCalls:
    """The N-th of some calls fails alone, or with all later ones, or with the later ones on the same file."""

    name: str
    calls: int
    error: int
    mode: int = FAIL

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return one for some of the calls of each command."""
        for scenario in scenarios(work, short, MAKES if self.name in IN_SHORT else None):
            met = [call for call in stage_of(work).unbroken(scenario).calls if call.what & self.calls]
            numbers = few(range(1, len(met) + 1), 1) if short else _of_each_file(met)
            for number in numbers:
                yield Fault(self.name, scenario.command, f"{number}")

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Run the command with the failure, then without."""
        stage, scenario = stage_of(work), OF_COMMAND[fault.command]
        with stage.begun(scenario) as case:
            met = case.with_name(f"{case.name}-met")
            what = armed(case, self.mode, int(fault.name), error=self.error, calls=self.calls, log=met)
            ran = work.forked(scenario.argv, case, armed=what)
            failed = met.stat().st_size > 0
            met.unlink()
            return judged(ran, scenario, case, work) if failed else not_met(ran)


def _of_each_file(calls: Sequence[Call]) -> list[int]:
    """Return the numbers of calls to fail, from 1: the first on each file, and others, evenly spread, up to `MOST`.

    Files whose names differ in numbers alone, as those of steps, blocks and processes do, count as one.
    """
    first: dict[str, int] = {}
    for number, call in enumerate(calls, 1):
        first.setdefault(re.sub(r"\d+", "0", call.path), number)
    spread = few(range(1, len(calls) + 1), max(MOST - len(first), 0))
    return sorted({*first.values(), *spread})


def failing_calls() -> list[FailingCalls]:
    """Return a kind for each call and error."""
    calls_of = {"write": WRITE, "fsync": FSYNC, "rename": RENAME, "open": OPEN | CREATE, "read": READ}
    # A bad place of a disk stays bad; of a write that is tried again at once it would be nothing.
    bad = {"write": FAIL_FILE, "read": FAIL_FILE}
    kinds = [FailingCalls(f"EIO in {name}", calls, errno.EIO, bad.get(name, FAIL)) for name, calls in calls_of.items()]
    # A disk that is full stays so.
    full = {"write": WRITE, "fsync": FSYNC, "rename": RENAME, "open": CREATE | MKDIR}
    return kinds + [FailingCalls(f"ENOSPC in {name}", calls, errno.ENOSPC, FAIL_ON) for name, calls in full.items()]


@contextmanager
def mounted(case: Path, *options: str) -> Iterator[None]:
    """Mount something over a folder, and take it away again."""
    subprocess.run(["mount", *options, str(case)], check=True, capture_output=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(case)], check=True, capture_output=True)


def must_mount() -> None:
    """Raise NotHereError unless this process may mount."""
    mount = shutil.which("mount")
    if os.geteuid() != 0 or mount is None:
        raise NotHereError("needs root and mount")
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        ran = subprocess.run([mount, "-t", "tmpfs", "-o", "size=64k", "tmpfs", folder], capture_output=True)
        if ran.returncode != 0:
            raise NotHereError(f"mount: {ran.stderr.decode(errors='replace').strip()}")
        subprocess.run(["umount", "-l", folder], check=True, capture_output=True)


@dataclass
class FullDisk:
    """A file system in memory that has room for a part of what the command writes."""

    name: str = "full disk"

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return some sizes for each command."""
        must_mount()
        for scenario in scenarios(work, short):
            for percent in (50,) if short else range(5, 100, 10):
                yield Fault(self.name, scenario.command, f"{percent} % of the room")

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Run the command there, then again with more room."""
        stage, scenario = stage_of(work), OF_COMMAND[fault.command]
        start = stage.start(scenario)
        before = _pages(start)
        with stage.begun(scenario) as case:
            ran = work.forked(scenario.argv, case)
            needed = _pages(case) - before
        room = max(before + int(fault.name.split()[0]) * needed // 100, 1)  # a size of 0 would be no bound
        with work.copy() as case, mounted(case, "-t", "tmpfs", "-o", f"size={4 * room}k", "tmpfs"):
            shutil.copytree(start, case, symlinks=True, dirs_exist_ok=True)
            ran = work.forked(scenario.argv, case)
            subprocess.run(["mount", "-o", "remount,size=256m", str(case)], check=True)
            return judged(ran, scenario, case, work)


def _pages(folder: Path) -> int:
    """Return how many pages of 4 kB a file system in memory needs for the files of a folder."""
    return sum((path.lstat().st_size + 4095) // 4096 for path in folder.rglob("*") if path.is_file())


@dataclass
class ReadOnly:
    """A working folder that is mounted read-only."""

    name: str = "read-only file system"

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return one for each command; none in the short form."""
        must_mount()
        for scenario in scenarios(work, short, None):
            yield Fault(self.name, scenario.command, "whole working folder")

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Run the command there, then again where it can write."""
        stage, scenario = stage_of(work), OF_COMMAND[fault.command]
        with stage.begun(scenario) as case:
            with mounted(case, "--bind", str(case)):
                subprocess.run(["mount", "-o", "remount,bind,ro", str(case)], check=True)
                ran = work.forked(scenario.argv, case)
            return judged(ran, scenario, case, work)


@dataclass
class Limits:
    """Few open files, or little memory more than the command has when it begins."""

    name: str
    limit: str
    values: tuple[int, ...]

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return some limits for each command."""
        for scenario in scenarios(work, short):
            for value in self.values[:1] if short else self.values:
                yield Fault(self.name, scenario.command, f"{value}")

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Run the command with the limit, then without."""
        stage, scenario = stage_of(work), OF_COMMAND[fault.command]
        value, memory = int(fault.name), self.limit == "RLIMIT_AS"
        if memory:
            value = value * 2**20 + work.address_space(lean=True)
        with stage.begun(scenario) as case:
            ran = work.forked(scenario.argv, case, limits={self.limit: value}, lean=memory)
            return judged(ran, scenario, case, work)
