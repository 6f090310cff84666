"""What is to be done, and the state of one worker that does it; the same in every engine.

U is a unit of work, a small picklable value; R is what comes of it.
"""

import contextlib
import traceback
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from graspq.common.errors import UserError, failure_of_machine

U_contra = TypeVar("U_contra", contravariant=True)
R_co = TypeVar("R_co", covariant=True)
R = TypeVar("R")

# Where a worker finds a folder of `Work.folders`: itself on the same machine, a copy of it on another.
Place = Callable[[Path], Path]


class Work(Protocol[U_contra, R_co]):
    """How units are done; travels to each worker once, pickled."""

    def folders(self) -> Sequence[Path]:
        """Return the folders that workers read, such as an object set; workers elsewhere get a copy."""

    def open(self, place: Place) -> AbstractContextManager[Callable[[U_contra], R_co]]:
        """Return what does units in one worker: entered at its first unit, left when the worker is not needed any more.

        What a unit gives may depend on the unit and the work alone, not on the units that were done before it.

        Args:
            place: returns where this worker finds one of `folders`.
        """


@dataclass(frozen=True)
class Done(Generic[R]):
    """A unit is done."""

    result: R


@dataclass(frozen=True)
class Mistake:
    """A unit raised a UserError with this message, or the machine failed it."""

    message: str
    of_machine: bool = False


@dataclass(frozen=True)
class Failed:
    """A unit raised another exception with this traceback."""

    traceback: str


@dataclass(frozen=True)
class Died:
    """A worker is gone.

    Attributes:
        how: in a few words, such as `killed by SIGSEGV`.
        with_node: it went with its whole machine, which says nothing about the unit.
    """

    how: str
    with_node: bool = False


Outcome = Done[R] | Mistake | Failed | Died


class Bench:
    """The state of one worker: the work is opened at the first unit and stays open."""

    def __init__(
        self, fetch_work: Callable[[], Work[Any, Any]], place: Place, unpack: Callable[[Any], Any] = lambda unit: unit
    ) -> None:
        """Prepare; nothing that can fail happens before the first unit.

        Args:
            fetch_work: returns the work.
            place: see `Work.open`.
            unpack: returns a unit as it is of what `do` is given.
        """
        self._fetch_work, self._place, self._unpack = fetch_work, place, unpack
        self._stack = contextlib.ExitStack()
        self._do: Callable[[Any], Any] | None = None

    def do(self, unit: Any) -> Outcome[Any]:
        """Return what comes of a unit, its exceptions too, so that none of them needs to be picklable.

        Raises:
            KeyboardInterrupt: a signal asked this process to end.
        """
        try:
            if self._do is None:
                self._do = self._stack.enter_context(self._fetch_work().open(self._place))
            return Done(self._do(self._unpack(unit)))
        except UserError as error:
            return Mistake(error.message)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            failure = failure_of_machine(error)
            return Failed(traceback.format_exc()) if failure is None else Mistake(failure.message, of_machine=True)

    def close(self) -> None:
        """Leave the work."""
        self._stack.close()
