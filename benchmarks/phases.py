"""Where the time of a collection goes: wrappers put around functions at run time, nothing in the code itself.

Time is exclusive: what a wrapped function spends in another wrapped one counts there. What runs in native code is told
apart by the phase of the grasp in which it is called.
"""

import functools
import time
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager
from types import TracebackType
from typing import Any

PYTHON = "Python"


class Stopwatch(AbstractContextManager["Stopwatch"]):
    """Books seconds and calls to (phase, what); inside the `with` statement all time goes somewhere.

    Attributes:
        seconds: spent in each (phase, what), time in further wrapped functions left out.
        core_seconds: the same in CPU time of this thread, which other work on the machine hardly changes.
        calls: made of each.
    """

    def __init__(self, phase: str) -> None:
        self.phase = phase
        self.seconds: Counter[tuple[str, str]] = Counter()
        self.core_seconds: Counter[tuple[str, str]] = Counter()
        self.calls: Counter[tuple[str, str]] = Counter()
        self._current = (phase, PYTHON)
        self._since = (0.0, 0.0)
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
            before, here = self._current, place()
            self._switch(here)
            self.calls[here] += 1
            try:
                return original(*arguments, **settings)
            finally:
                self._switch(before)

        self._wrapped.append((owner, name, original))
        setattr(owner, name, timed)

    def _switch(self, place: tuple[str, str]) -> None:
        now = _clocks()
        self.seconds[self._current] += now[0] - self._since[0]
        self.core_seconds[self._current] += now[1] - self._since[1]
        self._current, self._since = place, now

    def __enter__(self) -> "Stopwatch":
        self._current, self._since = (self.phase, PYTHON), _clocks()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._switch((self.phase, PYTHON))

    def unwrap(self) -> None:
        """Put the functions back as they were."""
        for owner, name, original in reversed(self._wrapped):
            setattr(owner, name, original)
        self._wrapped.clear()


def _clocks() -> tuple[float, float]:
    return time.perf_counter(), time.thread_time()
