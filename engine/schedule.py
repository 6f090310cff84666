"""Hands units to workers, whatever they run on, and deals with those that die: the part all engines share."""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Protocol, TypeVar

from graspq.common.errors import MachineError, UserError
from graspq.engine.work import Died, Done, Failed, Mistake, Outcome

U = TypeVar("U")
R = TypeVar("R")


class LostUnitsError(UserError):
    """Units that ended two workers each; all others are done.

    Attributes:
        lost: each unit, and how its last worker ended.
    """

    def __init__(self, message: str, lost: list[tuple[Any, str]]) -> None:
        super().__init__(message)
        self.lost = lost


DEATHS_ALLOWED = 1
NODE_DEATHS_ALLOWED = 10
_STARTS_ALLOWED = 3  # failures in a row, before anything is done


class Worker(Protocol):
    """A worker; `ready` says whether it can be given a unit."""

    ready: bool


class Team(Protocol):
    """The workers of one engine."""

    def hire(self) -> Any:
        """Start a `Worker` and return it."""

    def give(self, worker: Any, unit: Any) -> bool:
        """Give a unit to a worker that is ready and idle; return whether it could take it: else it has died idle."""

    def wait(self) -> list[tuple[Any, Outcome[Any] | None]]:
        """Wait for news and return it: what came of a worker's unit, or None where a worker got ready."""

    def dismiss(self, worker: Any) -> None:
        """End a worker that has no unit."""

    def close(self) -> None:
        """End all workers at once, whatever they do."""


def schedule(
    team: Team,
    units: Iterable[U],
    workers: int,
    name: Callable[[U], str],
    units_per_worker: int | None,
) -> Iterator[tuple[U, Any]]:
    """Yield each unit with its result; see `graspq.engine.run`. Closes the team, also when it is itself closed."""
    try:
        yield from _Schedule(team, units, workers, name, units_per_worker).run()
    finally:
        team.close()


class _Schedule:
    def __init__(
        self, team: Team, units: Iterable[Any], workers: int, name: Callable[[Any], str], units_per_worker: int | None
    ) -> None:
        self._team, self._workers, self._name, self._units_per_worker = team, workers, name, units_per_worker
        self._source = iter(enumerate(units))
        self._waiting: deque[tuple[int, Any]] = deque()
        self._starting: list[Worker] = []
        self._idle: list[Worker] = []
        self._busy: dict[Worker, tuple[int, Any]] = {}  # with the number of the unit
        self._finished: Counter[Worker] = Counter()
        self._deaths: Counter[int] = Counter()
        self._node_deaths: Counter[int] = Counter()
        self._failed_starts = 0
        self._lost: dict[int, tuple[Any, str]] = {}  # by the number of the unit: unit, how its worker ended

    def run(self) -> Iterator[tuple[Any, Any]]:
        results: list[tuple[Any, Any]] = []
        while True:
            # First new units, then results: workers are busy while the caller deals with what they made.
            self._hand_out()
            yield from results
            if not self._busy and not self._starting:
                break
            results = [found for worker, news in self._team.wait() for found in self._heard(worker, news)]
        if self._lost:
            raise self._losses("all else is done")

    def _losses(self, otherwise: str) -> LostUnitsError:
        lost = [self._lost[number] for number in sorted(self._lost)]
        names = ", ".join(f"{self._name(unit)} ({how})" for unit, how in lost)
        whose = "its" if len(lost) == 1 else "their"
        return LostUnitsError(f"{names} ended {whose} worker twice; {otherwise}", lost)

    def _hand_out(self) -> None:
        while True:
            if self._idle and self._available(1):
                worker = self._idle.pop()
                number, unit = self._waiting.popleft()
                if self._team.give(worker, unit):
                    self._busy[worker] = number, unit
                else:
                    self._waiting.appendleft((number, unit))
                    self._count_failed_start("they die while they wait for a unit")
            elif self._employed < self._workers and self._available(len(self._starting) + 1):
                worker = self._team.hire()
                (self._idle if worker.ready else self._starting).append(worker)
            else:
                break
        if not self._available(1):
            # On a cluster they make room for a worker that takes over the unit of a dead one.
            for worker in [*self._idle, *self._starting]:
                self._team.dismiss(worker)
            self._idle, self._starting = [], []

    @property
    def _employed(self) -> int:
        return len(self._idle) + len(self._busy) + len(self._starting)

    def _available(self, count: int) -> bool:
        """Return whether `count` units wait, after fetching no more than those."""
        while len(self._waiting) < count:
            fetched = next(self._source, None)
            if fetched is None:
                return False
            self._waiting.append(fetched)
        return True

    def _heard(self, worker: Worker, news: Outcome[Any] | None) -> list[tuple[Any, Any]]:
        if worker in self._starting:
            self._starting.remove(worker)
            self._started(worker, news)
            return []
        number, unit = self._busy.pop(worker)
        match news:
            case Done(result):
                self._failed_starts = 0
                self._finished[worker] += 1
                if self._units_per_worker is not None and self._finished[worker] >= self._units_per_worker:
                    self._team.dismiss(worker)
                else:
                    self._idle.append(worker)
                return [(unit, result)]
            case Mistake(message, of_machine):
                raise (MachineError if of_machine else UserError)(message)
            case Failed(traceback):
                raise RuntimeError(f"{self._name(unit)} failed in a worker:\n{traceback}")
            case Died():
                self._count_death(number, unit, news)
        return []

    def _started(self, worker: Worker, news: Outcome[Any] | None) -> None:
        if not isinstance(news, Died):
            self._idle.append(worker)
            return
        self._count_failed_start(news.how)

    def _count_failed_start(self, how: str) -> None:
        self._failed_starts += 1
        if self._failed_starts > _STARTS_ALLOWED:
            raise UserError(f"workers cannot start: {how}")

    def _count_death(self, number: int, unit: Any, died: Died) -> None:
        counts, allowed = (self._node_deaths, NODE_DEATHS_ALLOWED) if died.with_node else (self._deaths, DEATHS_ALLOWED)
        counts[number] += 1
        if counts[number] > allowed:
            self._lost[number] = unit, died.how
            if len(self._lost) > _STARTS_ALLOWED and not self._finished:
                raise self._losses("no unit could be done")
        else:
            self._waiting.appendleft((number, unit))
