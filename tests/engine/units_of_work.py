"""Works for the tests of the engine; a module of its own, because workers import it."""

import contextlib
import errno
import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from graspq.common.errors import UserError, told


@dataclass(frozen=True)
class Squares:
    """Squares numbers, and does worse with some of them.

    Attributes:
        notes: folder in which each worker leaves a file when it opens and when it closes, and each unit when it begins.
    """

    notes: Path | None = None

    def folders(self):
        return []

    def note(self, name):
        if self.notes is not None:
            (self.notes / f"{name}-{os.getpid()}-{time.monotonic_ns()}").touch()

    @contextlib.contextmanager
    def open(self, place):
        self.note("open")
        try:
            yield self.square
        finally:
            self.note("close")

    def square(self, unit):
        self.note(f"unit{unit}" if isinstance(unit, int) else "unit")
        match unit:
            case ("die once", mark):
                if not Path(mark).exists():
                    Path(mark).touch()
                    os.kill(os.getpid(), signal.SIGKILL)
                return 0
            case ("interrupted once", mark):
                if not Path(mark).exists():
                    Path(mark).touch()
                    raise KeyboardInterrupt  # as a unit that handles SIGTERM does
                return 0
            case "die":
                os.kill(os.getpid(), signal.SIGKILL)
            case "exit":
                os._exit(7)
            case "mistake":
                raise UserError("--size: a mistake of the user's; choose another")
            case "full":
                raise told(OSError(errno.ENOSPC, "full"), "data: the disk is full")
            case "defect":
                raise ZeroDivisionError("deep in a worker")
            case ("large", size):
                return bytes(size)
            case ("sleep", seconds):
                time.sleep(seconds)
                return seconds
        return unit * unit


def cannot_be_unpickled():
    raise MemoryError


class TooLarge:
    """A unit for which a worker has too little memory before it has begun."""

    def __reduce__(self):
        return cannot_be_unpickled, ()


@dataclass(frozen=True)
class ReadsFolder:
    """Reads files of a folder; says from where."""

    folder: Path

    def folders(self):
        return [self.folder]

    @contextlib.contextmanager
    def open(self, place):
        yield lambda name: (str(place(self.folder)), (place(self.folder) / name).read_text(), time.sleep(0.5))
