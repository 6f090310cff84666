"""Stopping a run by hand: the step that runs ends first, so that a checkpoint of it can be written.

A context manager puts its own handlers of SIGINT and SIGTERM in place of those that are there, and puts them back.
"""

import signal
import threading
from types import FrameType
from typing import Any


class Interruption:
    """Notes SIGINT and SIGTERM so that the step that runs ends first; a second one interrupts at once."""

    def __init__(self) -> None:
        self.requested = False
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> "Interruption":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._note)
        return self

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
