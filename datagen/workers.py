"""Local execution: worker processes that each hold one simulation and collect the blocks they are given.

A worker that dies is normal (the simulator is native code): its block is given to a new one, and a block that kills two
workers stops the run by its name. Workers are renewed between blocks, because the simulator leaks shapes.
"""

import dataclasses
import multiprocessing
import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from graspq.common.errors import UserError
from graspq.datagen.collect import collect_block
from graspq.datagen.settings import CollectionSettings
from graspq.datasets.episode import Episode
from graspq.objects.object_set import ObjectSet
from graspq.sim.episode import GraspSimulation
from graspq.sim.play import Policy
from graspq.sim.task import Task, task_from_json

BLOCKS_PER_WORKER = 500
_DEATHS_ALLOWED = 1

PolicyMaker = Callable[[], Policy]


@dataclasses.dataclass(frozen=True)
class BlockJob:
    """A block to collect: its number and how many of its episodes; see `collect_block`."""

    block: int
    episodes: int
    first_episode: int | None = None


_Setup = tuple[dict[str, Any], Path, CollectionSettings, PolicyMaker | None]


@dataclasses.dataclass
class _Worker:
    process: multiprocessing.process.BaseProcess
    connection: Connection
    job: BlockJob | None = None
    finished: int = 0


def collect_blocks(
    jobs: Iterable[BlockJob],
    task: Task,
    objects: Path,
    settings: CollectionSettings,
    workers: int,
    make_policy: PolicyMaker | None = None,
) -> Iterator[tuple[BlockJob, list[Episode]]]:
    """Collect blocks in `workers` processes and yield each as it is finished, in any order.

    Args:
        jobs: what to collect.
        task: of the dataset.
        objects: folder of its object set.
        settings: of the dataset.
        workers: number of processes; 0 collects in this one.
        make_policy: makes who acts, in each worker: it travels there pickled; the random policy where not given.

    Raises:
        UserError: a block killed its worker twice.
        RuntimeError: a worker reported an error of ours; the message holds its traceback.
    """
    if workers == 0:
        yield from _collect_here(jobs, task, objects, settings, make_policy)
        return
    waiting = deque(jobs)
    deaths: dict[int, int] = {}
    team: list[_Worker] = []
    setup = (task.settings.to_json(), objects, settings, make_policy)
    try:
        while waiting or any(worker.job is not None for worker in team):
            _employ(team, waiting, workers, setup)
            for connection in wait([worker.connection for worker in team if worker.job is not None]):
                worker = next(worker for worker in team if worker.connection is connection)
                finished = _receive(worker)
                if finished is not None:
                    yield finished
                    continue
                team.remove(worker)
                waiting.appendleft(_count_death(worker, deaths))
    finally:
        for worker in team:
            _dismiss(worker)


def _collect_here(
    jobs: Iterable[BlockJob],
    task: Task,
    objects: Path,
    settings: CollectionSettings,
    make_policy: PolicyMaker | None,
) -> Iterator[tuple[BlockJob, list[Episode]]]:
    policy = make_policy() if make_policy is not None else None
    with GraspSimulation(task, ObjectSet.load(objects)) as simulation:
        for job in jobs:
            yield job, collect_block(simulation, settings, job.block, job.episodes, policy, job.first_episode)


def _employ(
    team: list[_Worker],
    waiting: deque[BlockJob],
    workers: int,
    setup: _Setup,
) -> None:
    """Renew tired workers, fill the team, and give every idle worker a job."""
    for worker in [member for member in team if member.job is None and member.finished >= BLOCKS_PER_WORKER]:
        _dismiss(worker)
        team.remove(worker)
    while waiting and len(team) < workers:
        team.append(_hire(setup))
    for worker in team:
        if worker.job is None and waiting:
            worker.job = waiting.popleft()
            worker.connection.send(worker.job)


def _hire(setup: _Setup) -> _Worker:
    # Spawned, not forked: a fork would copy threads' locks and the parent's physics clients.
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs, *setup), daemon=True)
    process.start()
    theirs.close()
    return _Worker(process, ours)


def _receive(worker: _Worker) -> tuple[BlockJob, list[Episode]] | None:
    """Return the worker's finished job, or None if it died."""
    try:
        result = worker.connection.recv()
    except (EOFError, ConnectionResetError):
        worker.process.join(timeout=10)
        return None
    if isinstance(result, UserError):
        raise result
    if isinstance(result, str):
        raise RuntimeError(f"collecting block {worker.job.block if worker.job else '?'} failed:\n{result}")
    job, worker.job = worker.job, None
    worker.finished += 1
    assert job is not None
    return job, result


def _count_death(worker: _Worker, deaths: dict[int, int]) -> BlockJob:
    job = worker.job
    assert job is not None
    deaths[job.block] = deaths.get(job.block, 0) + 1
    if deaths[job.block] > _DEATHS_ALLOWED:
        raise UserError(
            f"block {job.block} ended its worker process twice (exit code {worker.process.exitcode}); "
            "finished shards are kept; check the object set with `grasp-objects show` or take another --seed"
        )
    return job


def _dismiss(worker: _Worker) -> None:
    worker.connection.close()
    if worker.job is not None:
        worker.process.terminate()
    worker.process.join(timeout=10)


def _work(
    connection: Connection,
    task: dict[str, Any],
    objects: Path,
    settings: CollectionSettings,
    make_policy: PolicyMaker | None,
) -> None:
    """Collect blocks until the other end of the pipe is closed; the parent alone answers Ctrl-C."""
    import traceback

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        for finished in _collect_here(
            iter(connection.recv, None), task_from_json(task), objects, settings, make_policy
        ):
            connection.send(finished[1])
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return  # the parent is gone or needs us no more
    except UserError as error:
        connection.send(error)
    except Exception:
        connection.send(traceback.format_exc())
