"""Where time goes: wrappers put around functions at run time, nothing in the code itself."""

import functools
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

PYTHON = "Python"


class Stopwatch(ExitStack):
    """Books time to (phase, what), by default CPU time of this thread; inside the `with` statement all goes somewhere.

    Time is exclusive: what a wrapped function spends in another wrapped one counts there. What runs in native code is
    told apart by the phase in which it is called.
    """

    def __init__(self, phase: str, clock: Callable[[], float] = time.thread_time) -> None:
        """Book to a phase what no wrapped function takes."""
        super().__init__()
        self.seconds: defaultdict[tuple[str, str], float] = defaultdict(float)
        self._clock, self._current, self._since = clock, (phase, PYTHON), clock()
        self.callback(self._switch, self._current)

    def wrap(self, owner: Any, name: str, phase: str | None = None, what: str = PYTHON) -> None:
        """Book a function as `what` of a phase that it opens, or of whatever phase it is called in; until the end."""
        original = getattr(owner, name)

        @functools.wraps(original)
        def timed(*arguments: Any, **settings: Any) -> Any:
            before = self._current
            self._switch((phase or before[0], what))
            try:
                return original(*arguments, **settings)
            finally:
                self._switch(before)

        setattr(owner, name, timed)
        self.callback(setattr, owner, name, original)

    def _switch(self, place: tuple[str, str]) -> None:
        now = self._clock()
        self.seconds[self._current] += now - self._since
        self._current, self._since = place, now
