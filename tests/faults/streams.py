"""Standard streams as shells, services and pipes give them: closed, full, without a reader, on a tiny terminal."""

import contextlib
import fcntl
import os
import struct
import subprocess
import termios
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

from tests.faults.commands import LINES, TRAIN, Running
from tests.faults.harness import Fault, Tried, Work


@dataclass(frozen=True)
class Streams:
    """How a command is started.

    Attributes:
        closed: descriptors that are closed.
        broken: outputs whose pipe nobody reads.
        full: outputs that go to a full device.
        terminal: columns of the terminal that it is started on.
        env: variables besides.
    """

    closed: tuple[int, ...] = ()
    broken: tuple[int, ...] = ()
    full: tuple[int, ...] = ()
    terminal: int | None = None
    env: dict[str, str] = field(default_factory=dict)


CASES = {
    "standard input closed": Streams(closed=(0,)),
    "standard output closed": Streams(closed=(1,)),
    "standard error closed": Streams(closed=(2,)),
    "all closed": Streams(closed=(0, 1, 2)),
    "nobody reads standard output": Streams(broken=(1,)),
    "nobody reads either": Streams(broken=(1, 2)),
    "standard output full": Streams(full=(1,)),
    "standard error full": Streams(full=(2,)),
    "a terminal of one column": Streams(terminal=1),
    "a dumb terminal": Streams(terminal=80, env={"TERM": "dumb"}),
    "ASCII alone": Streams(env={"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}),
}
# What a command says is lost with them: it may end early, without a word.
MAY_END = ("nobody reads", "full")


class ClosedStreams:
    """Streams that are not there."""

    name = "streams"

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return each command with each kind of streams."""
        for line in (TRAIN,) if short else LINES:
            for name in ("all closed",) if short else CASES:
                yield Fault(self.name, line.name, name)

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Run it, and again with streams that are there if it could not come to its end."""
        line = next(one for one in LINES if one.name == fault.command)
        with line.case(work) as case, _given(CASES[fault.name]) as (options, shown):
            ran = Running(work, line.words, case, CASES[fault.name].env, **options).ended()
            broken = replace(ran, stderr=ran.stderr + b"".join(shown).decode(errors="replace")).broken()
            if broken is not None:
                return broken
            if ran.rc == 0:
                return line.fits(case, work, ran if ran.stdout else None)
            if not any(words in fault.name for words in MAY_END):
                return Tried("lost", f"exit status {ran.rc}: {ran.line}")
            after = line.goes_on(case, work)
            return Tried("detected", f"exit status {ran.rc}") if after.outcome == "survived" else after


@contextlib.contextmanager
def _given(streams: Streams) -> Iterator[tuple[dict[str, Any], list[bytes]]]:
    """Yield the streams as options of a process, and what a terminal among them shows."""
    names, opened, shown = {1: "stdout", 2: "stderr"}, list[int](), list[bytes]()
    options: dict[str, Any] = {}
    for number in streams.broken:
        reading, writing = os.pipe()
        os.close(reading)
        options[names[number]] = writing
        opened.append(writing)
    for number in streams.full:
        options[names[number]] = os.open("/dev/full", os.O_WRONLY)
        opened.append(options[names[number]])
    if streams.terminal is not None:
        ours, theirs = os.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 2, streams.terminal, 0, 0))
        options |= {"stdin": theirs, "stderr": theirs, "stdout": subprocess.PIPE}
        opened.append(theirs)
        threading.Thread(target=_read_all, args=(ours, shown), daemon=True).start()
    if streams.closed:
        options["preexec_fn"] = lambda: [os.close(number) for number in streams.closed]
    try:
        yield options, shown
    finally:
        for one in opened:
            os.close(one)


def _read_all(terminal: int, shown: list[bytes]) -> None:
    with contextlib.suppress(OSError):
        while text := os.read(terminal, 4096):
            shown.append(text)
    os.close(terminal)
