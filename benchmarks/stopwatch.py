"""Where the time of a collection goes: wrappers put around functions at run time, nothing in the code itself."""

import functools
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

PYTHON = "Python"


class Stopwatch(AbstractContextManager["Stopwatch"]):
    """Books CPU time of this thread to (phase, what); inside the `with` statement all time goes somewhere.

    Time is exclusive: what a wrapped function spends in another wrapped one counts there. What runs in native code is
    told apart by the phase in which it is called.
    """

    def __init__(self, phase: str) -> None:
        """Book to a phase what no wrapped function takes."""
        self.seconds: defaultdict[tuple[str, str], float] = defaultdict(float)
        self._first = self._current = (phase, PYTHON)
        self._since = 0.0
        self._wrapped: list[tuple[Any, str, Any]] = []

    def as_phase(self, owner: Any, name: str, phase: str) -> None:
        """Let a function open a phase: what it does itself is the phase's Python."""
        self._wrap(owner, name, lambda: (phase, PYTHON))

    def as_part(self, owner: Any, name: str, what: str) -> None:
        """Book a function as `what` within whatever phase it is called in."""
        self._wrap(owner, name, lambda: (self._current[0], what))

    def _wrap(self, owner: Any, name: str, place: Callable[[], tuple[str, str]]) -> None:
        original = getattr(owner, name)

        @functools.wraps(original)
        def timed(*arguments: Any, **settings: Any) -> Any:
            before = self._current
            self._switch(place())
            try:
                return original(*arguments, **settings)
            finally:
                self._switch(before)

        self._wrapped.append((owner, name, original))
        setattr(owner, name, timed)

    def _switch(self, place: tuple[str, str]) -> None:
        now = time.thread_time()
        self.seconds[self._current] += now - self._since
        self._current, self._since = place, now

    def __enter__(self) -> "Stopwatch":
        self._current, self._since = self._first, time.thread_time()
        return self

    def __exit__(self, *error: object) -> None:
        self._switch(self._first)
        for owner, name, original in reversed(self._wrapped):
            setattr(owner, name, original)
        self._wrapped.clear()
