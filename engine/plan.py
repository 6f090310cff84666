"""A plan: a list of units, each named by what it is and done when its output is there.

Nothing else is remembered, so that a plan that was stopped or killed at any moment goes on by the same call.
"""

import contextlib
import traceback
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from graspq.common.checksums import read_checked_json
from graspq.common.errors import UserError, failure_of_machine, refuse_other

PLAN_FILE = "plan.json"


class Unit(Protocol):
    """One piece of a plan."""

    @property
    def name(self) -> str:
        """What it is; no other unit of its plan has this name."""

    def done(self) -> bool:
        """Return whether its output is there."""

    def run(self) -> None:
        """Make the output, from what there is of it.

        Raises:
            UserError: why it failed.
        """


U = TypeVar("U", bound=Unit)


@dataclass(frozen=True)
class Step:
    """A unit of a plan that is carried out in this process, of two functions."""

    name: str
    done: Callable[[], bool]
    run: Callable[[], None]


@dataclass(frozen=True)
class Ending(Generic[U]):
    """What became of a unit.

    Attributes:
        unit: the unit.
        skipped: it was done before.
        error: why it failed, in one line; None where it is done.
    """

    unit: U
    skipped: bool = False
    error: str | None = None


# Has units done by the engine's workers, in any order, and yields each with why it failed, if it did.
HandOut = Callable[[Sequence[U]], Generator[tuple[U, str | None], None, None]]


def carry_out(
    units: Iterable[U],
    report: Callable[[Ending[U]], None],
    *,
    again: bool = False,
    keep_going: bool = True,
    hand_out: HandOut[U] | None = None,
) -> None:
    """Run the units that are not done, and report what became of each as soon as it is known.

    Args:
        units: in this process they run in this order, so one may need what those before it have made; with `hand_out`
            none may need another.
        report: called in this process, also for units that were done before.
        again: run what is done too.
        keep_going: report a failure and go on with the others; else it is raised. Of `hand_out` all are reported.
        hand_out: has them done by workers.

    Raises:
        KeyboardInterrupt: a signal asked the plan to end; the same call goes on with it.
        MachineError: the machine fails, such as a full disk, which would fail the other units too; so does the call.
    """
    waiting: list[U] = []
    for unit in units:
        if not again and unit.done():
            report(Ending(unit, skipped=True))
        elif hand_out is None:
            report(Ending(unit, error=_attempt(unit, keep_going)))
        else:
            waiting.append(unit)
    if hand_out is not None and waiting:
        with contextlib.closing(hand_out(waiting)) as ended:
            for unit, error in ended:
                report(Ending(unit, error=error))


def _attempt(unit: Unit, keep_going: bool) -> str | None:
    try:
        unit.run()
    except UserError as error:
        if not keep_going:
            raise
        return error.message
    except Exception as error:  # a defect: the others go on, and its traceback is shown
        failure = failure_of_machine(error)
        if failure is not None:
            raise failure from None
        if not keep_going:
            raise
        traceback.print_exc()
        return f"{type(error).__name__}: {error}"
    return None


def older_units(
    folder: Path, what: str, shared: Mapping[str, Any], fixed: Sequence[str], restored: Callable[[Any], U]
) -> list[U]:
    """Return the units of the `plan.json` of a folder, none where it has none: a plan can grow, not become another.

    Args:
        folder: of the plan.
        what: what it is a plan of, such as `sweep`.
        shared: what the units of the plan share that is asked for now, as JSON; its `format_version` with it.
        fixed: names of what must be as it was.
        restored: makes a unit of its entry in `jobs`.

    Raises:
        UserError: the folder's plan is another, or the file is no plan.
    """
    path = folder / PLAN_FILE
    if not path.exists():
        return []
    older = read_checked_json(path, f"plan of a {what}", "choose another --out, or delete it to plan anew")
    try:
        theirs, ours = ({name: one[name] for name in ("format_version", *fixed)} for one in (older, shared))
        refuse_other(folder, f"a {what}", theirs, ours, "choose another --out")
        return [restored(entry) for entry in older["jobs"]]
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path}: not a whole plan of a {what} ({error}); choose another --out") from None
