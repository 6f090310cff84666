"""Workers as actors of Ray: of a Ray that is started on this machine, or of a cluster that is there.

What workers read goes to them through Ray's object store, and what they make comes back through it: no shared disk.
"""

import contextlib
import logging
import os
import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from graspq.common.errors import UserError
from graspq.common.files import temporary_folder
from graspq.common.machine import available_cores
from graspq.engine.shipping import digest_of, packed, received
from graspq.engine.work import Bench, Died, Failed, Outcome, Work

try:
    import ray
    from ray.exceptions import OutOfMemoryError, RayError, RayTaskError
except ModuleNotFoundError:
    raise UserError("--engine ray: Ray is not installed; pip install 'graspq[ray]', or use --engine local") from None

_SOCKET_ROOM = 44  # Ray's sockets lie deep in its folder, and the path of one may have 107 characters
_CONNECT_SECONDS = 10.0
_CLOSE_SECONDS = 10.0


@contextlib.contextmanager
def connected(address: str | None, workers: int | None, cpus_per_worker: int) -> Iterator[int]:
    """Be connected to Ray, and yield the number of workers to hire; a connection that is there already is used.

    Args:
        address: of a cluster that is there, or `auto`; None starts a Ray of this machine's own, which ends with us.
        workers: as asked for; None for as many as there are cores in the cluster.
        cpus_per_worker: cores of each.

    Raises:
        UserError: there is no such cluster, it has no free core, or it fails.
    """
    with contextlib.ExitStack() as stack:
        if not ray.is_initialized():
            stack.enter_context(_own_ray(workers, cpus_per_worker) if address is None else _cluster(address))
        cores = int(ray.cluster_resources().get("CPU", 0))
        if cores < cpus_per_worker:
            raise UserError(
                f"--ray-address: the cluster has {cores} CPUs, a worker needs {cpus_per_worker}; add nodes to it"
            )
        try:
            yield workers if workers is not None else cores // cpus_per_worker
        except RayError as error:  # such as a full object store, or a head that is gone
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            raise UserError(f"--engine ray: Ray failed ({reason}); the same command goes on once it works") from None


_QUIET: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}


@contextlib.contextmanager
def _own_ray(workers: int | None, cpus_per_worker: int) -> Iterator[None]:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # Actors that ask for no GPU still see those of this machine, as workers of the local engine do.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    cores = available_cores() if workers is None else workers * cpus_per_worker
    with _removed_in_any_case() as folder:
        ray.init("local", num_cpus=cores, include_dashboard=False, _temp_dir=str(folder), **_QUIET)
        try:
            yield
        finally:
            ray.shutdown()


@contextlib.contextmanager
def _cluster(address: str) -> Iterator[None]:
    try:
        if address != "auto":
            # Ray itself would try for minutes.
            host, _, port = address.rpartition(":")
            socket.create_connection((host, int(port)), timeout=_CONNECT_SECONDS).close()
        ray.init(address=address, **_QUIET)
    except (OSError, ValueError, RuntimeError) as error:
        reason = str(error).strip().split("\n")[0]
        raise UserError(
            f"--ray-address: no cluster at {address!r} ({reason}); expected HOST:PORT or auto; start one with "
            "`ray start --head`, or leave the option out"
        ) from None
    try:
        yield
    finally:
        ray.shutdown()


# What sweeps up after us, when its standard input has ended with us. Ray's processes end soon then, but for agents that
# try for a minute to tell the others; all of them write logs into the folder.
_SWEEPER = """
cat >/dev/null; sleep 1
for process in /proc/[0-9]*; do ls -l "$process/fd" 2>/dev/null | grep -qF " $0/" && kill -9 "${process#/proc/}"; done
sleep 0.5; rm -rf -- "$0"
"""


@contextlib.contextmanager
def _removed_in_any_case() -> Iterator[Path]:
    """Yield a temporary folder that goes when this process ends, even by SIGKILL, and with it what works in it."""
    with temporary_folder("ray", _SOCKET_ROOM) as folder:
        words = ["sh", "-c", _SWEEPER, str(folder)]
        sweeper = subprocess.Popen(words, stdin=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True)
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)
            sweeper.kill()
            sweeper.wait()


class RayWorker:
    """One actor; ready once it runs on some node."""

    def __init__(self, actor: Any) -> None:
        """Take over an actor that is being started."""
        self.actor, self.ready, self.node = actor, False, ""


class RayTeam:
    """Actors of the connected Ray; see `schedule.Team`."""

    def __init__(self, work: Work[Any, Any], cpus_per_worker: int) -> None:
        """Put what workers read into the object store; hire nobody yet."""
        self._work = ray.put(work)
        self._shipped: dict[str, tuple[str, Any]] = {}
        for folder in work.folders():
            content = packed(folder)
            self._shipped[str(folder)] = digest_of(content), ray.put(content)
        self._actor = ray.remote(num_cpus=cpus_per_worker, max_restarts=0, max_task_retries=0)(_actor_class())
        self._workers: list[RayWorker] = []
        self._pending: dict[Any, RayWorker] = {}

    def hire(self) -> RayWorker:
        """Start an actor on whichever node has room; it is ready when `wait` says so."""
        home = ray.get_runtime_context().get_node_id()
        worker = RayWorker(self._actor.remote(str(Path.cwd()), [self._work], self._shipped, home))
        self._workers.append(worker)
        self._pending[worker.actor.node.remote()] = worker
        return worker

    def give(self, worker: RayWorker, unit: Any) -> bool:
        """Give a unit to an idle worker."""
        self._pending[worker.actor.do.remote(unit)] = worker
        return True

    def wait(self) -> list[tuple[RayWorker, Outcome[Any] | None]]:
        """Wait until a worker is ready, has done a unit, or has died."""
        finished, _ = ray.wait(list(self._pending), num_returns=1)
        return [self._heard(self._pending.pop(reference), reference) for reference in finished]

    def _heard(self, worker: RayWorker, reference: Any) -> tuple[RayWorker, Outcome[Any] | None]:
        try:
            answer = ray.get(reference)
        except RayTaskError as error:  # such as a unit that cannot be pickled
            return worker, Failed(str(error))
        except RayError as error:
            self._workers.remove(worker)
            ray.kill(worker.actor)
            if worker.ready and not _alive(worker.node):
                return worker, Died("its node is gone", with_node=True)
            return worker, Died(_how(error))
        if worker.ready:
            return worker, answer
        worker.node, worker.ready = answer, True
        return worker, None

    def dismiss(self, worker: RayWorker) -> None:
        """End an idle worker, or one that is still being started."""
        self._workers.remove(worker)
        self._pending = {reference: other for reference, other in self._pending.items() if other is not worker}
        if worker.ready:
            with contextlib.suppress(RayError):
                ray.get(worker.actor.close.remote(), timeout=_CLOSE_SECONDS)
        ray.kill(worker.actor)

    def close(self) -> None:
        """Kill all actors."""
        for worker in self._workers:
            ray.kill(worker.actor)
        self._workers, self._pending = [], {}


def _alive(node: str) -> bool:
    return any(found["NodeID"] == node and found["Alive"] for found in ray.nodes())


def _how(error: RayError) -> str:
    text = str(error)
    if "creation task" in text:  # an exception, whose last line says which
        return [line.strip() for line in text.splitlines() if line.strip(" ^~")][-1]
    return "killed for want of memory" if isinstance(error, OutOfMemoryError) else "its process ended"


def _actor_class() -> type:
    """Return the class of the actors; as a local class it travels by value, so that its first lines run first."""

    class Actor:
        def __init__(self, caller_folder: str, *arguments: Any) -> None:
            # Ray puts the caller's working folder first. In a checkout of graspq, folders such as `datasets` would
            # there shadow the libraries of that name; at the end it is for modules that the user names.
            import sys

            sys.path = [*(path for path in sys.path if path != caller_folder), caller_folder]
            from graspq.engine.ray import Member

            self._member = Member(caller_folder, *arguments)

        def node(self) -> str:
            return self._member.node

        def do(self, unit: Any) -> Any:
            return self._member.bench.do(unit)

        def close(self) -> None:
            self._member.bench.close()

    return Actor


class Member:
    """What an actor holds: the same state of a worker as everywhere.

    Attributes:
        node: that it runs on.
        bench: the state.
    """

    def __init__(self, caller_folder: str, work: list[Any], shipped: dict[str, tuple[str, Any]], home: str) -> None:
        """Prepare.

        Args:
            caller_folder: working folder of the process that hands out the units, which need not be this one's.
            work: reference of the `Work`, in a list so that it is fetched late.
            shipped: folder -> digest and reference of its packed content.
            home: node of the process that hands out the units: there the folders themselves are at hand.
        """
        self.node = str(ray.get_runtime_context().get_node_id())

        def place(folder: Path) -> Path:
            digest, reference = shipped[str(folder)]
            return Path(caller_folder, folder) if self.node == home else received(digest, lambda: ray.get(reference))

        self.bench = Bench(lambda: ray.get(work[0]), place)
