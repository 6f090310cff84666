"""`run`: the one way to have units of work done."""

import pickle
from collections.abc import Callable, Generator, Iterable, Sequence
from typing import TypeVar

from graspq.common.machine import available_cores
from graspq.engine.local import LocalTeam, warm_up
from graspq.engine.schedule import schedule
from graspq.engine.settings import EngineSettings
from graspq.engine.work import Work

U = TypeVar("U")
R = TypeVar("R")


def run(
    work: Work[U, R],
    units: Iterable[U],
    settings: EngineSettings,
    *,
    name: Callable[[U], str] = str,
    units_per_worker: int | None = None,
    cpus_per_worker: int = 1,
    modules: Sequence[str] = (),
) -> Generator[tuple[U, R], None, None]:
    """Do units in workers and yield each with its result as it is finished, in any order.

    Results do not depend on the engine, the number of workers or the order. A worker that dies gives its unit to
    another. The units are fetched as workers get free, so there may be any number of them. When the generator is
    closed, or the process ends in any way, no worker stays.

    Args:
        work: how units are done.
        units: what is to be done; picklable.
        settings: engine and number of workers.
        name: what a unit is called in messages, such as `block 7`.
        units_per_worker: a worker is renewed after so many; for native code that leaks.
        cpus_per_worker: cores that a worker takes of a Ray cluster, and by which the default number of workers is
            reckoned.
        modules: what workers of this machine will import; see `warm_up`.

    Raises:
        UserError: a unit raised it; or units ended two workers each: these are named, after all others are done.
        RuntimeError: a unit raised another exception in a worker; the message holds its traceback.
    """
    if settings.workers == 0:
        yield from _here(work, units)
        return
    if settings.engine == "ray":
        # Imported late: Ray is an extra, and takes a second to import.
        from graspq.engine.ray import RayTeam, connected

        with connected(settings.ray_address, settings.workers, cpus_per_worker) as workers:
            team = RayTeam(work, cpus_per_worker)
            yield from schedule(team, units, workers, name, units_per_worker)
        return
    warm_up(modules)
    count = settings.workers if settings.workers is not None else max(available_cores() // cpus_per_worker, 1)
    yield from schedule(LocalTeam(pickle.dumps(work)), units, count, name, units_per_worker)


def _here(work: Work[U, R], units: Iterable[U]) -> Generator[tuple[U, R], None, None]:
    with work.open(lambda folder: folder) as do:
        for unit in units:
            yield unit, do(unit)
