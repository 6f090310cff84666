"""Workers as processes of this machine: each an executor of one process, so that a death is that of one unit.

They are forked, but not from this process, whose threads' locks and physics clients they would copy: a server without
threads, which has imported what they need, forks them at once.
"""

import concurrent.futures
import contextlib
import functools
import multiprocessing
import multiprocessing.forkserver
import multiprocessing.util
import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from graspq.common.errors import UserError
from graspq.common.files import temporary_folder
from graspq.engine import server
from graspq.engine.work import Bench, Died, Failed, Outcome

GRACE_SECONDS = 30.0
ORPHAN_SECONDS = 3.0
_SOCKET_ROOM = 80  # the path of a socket may have 107 bytes, its name in the folder has 18
_SERVERS_ALLOWED = 3
_SERVER_GONE = 255  # what multiprocessing says of a process whose server was killed
_NOT_BEGUN = os.EX_OSERR
_bench: Bench | None = None


def warm_up(modules: Sequence[str]) -> None:
    """Start the server that workers are forked from, and have it import modules meanwhile; returns at once.

    It ends with this process. Once it runs, this does nothing.
    """
    multiprocessing.set_forkserver_preload([server.__name__, *modules])
    os.environ[server.FOLDER] = str(_sockets_folder())
    try:
        with _interrupts_blocked():
            multiprocessing.forkserver.ensure_running()
    finally:
        del os.environ[server.FOLDER]


@functools.cache
def _sockets_folder() -> Path:
    """Have multiprocessing keep its sockets in a folder of ours, whose leftovers can be told from those of others."""
    opened = contextlib.ExitStack()
    folder = opened.enter_context(temporary_folder("workers", _SOCKET_ROOM))
    multiprocessing.util.Finalize(None, opened.close, exitpriority=-100)
    multiprocessing.current_process()._config["tempdir"] = str(folder)  # type: ignore[attr-defined]
    return folder


class LocalWorker:
    """One process."""

    ready = True

    def __init__(self, work: bytes) -> None:
        """Prepare it; it opens the pickled work with its first unit."""
        context = multiprocessing.get_context("forkserver")
        # The server has the environment of its own start.
        begin = (work, dict(os.environ))
        self._executor: Any = ProcessPoolExecutor(1, mp_context=context, initializer=_begin, initargs=begin)
        # The executor puts its process there, and forgets this dictionary in the end.
        self._of_executor: Any = self._executor._processes

    @property
    def _processes(self) -> list[Any]:
        return list(self._of_executor.values())

    def start(self) -> None:
        """Start the process.

        Raises:
            EOFError, ConnectionError: the server was killed at that moment.
        """
        with _interrupts_blocked():
            self._executor.submit(int)  # the executor starts its process with the first thing to do
        # Only the process itself holds the writing end: killed in the midst of a result it ends the pipe, and the
        # executor's thread that reads there does not wait for the rest for ever.
        self._executor._result_queue._writer.close()

    def submit(self, unit: Any) -> "Future[Outcome[Any]]":
        """Give it a unit."""
        future: Future[Outcome[Any]] = self._executor.submit(_do, _Packed(unit))
        return future

    def outcome(self, future: "Future[Outcome[Any]]") -> Outcome[Any]:
        """Return what came of a unit; the worker is gone where it died."""
        error = future.exception()
        if error is None:
            return future.result()
        if isinstance(error, BrokenProcessPool):
            self.end()
            codes = {process.exitcode for process in self._processes} - {None}
            if _SERVER_GONE in codes:
                for number in filter(None, (process.pid for process in self._processes)):
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(number, signal.SIGKILL)  # it may live on, and hold what another will be given
            return Died(_how(next(iter(codes), None)))
        if isinstance(error, KeyboardInterrupt):  # its unit heard a SIGTERM
            self.end()
            return Died("asked to end by SIGTERM")
        return Failed(f"{type(error).__name__}: {error}")  # such as a unit that cannot be pickled

    def end(self) -> None:
        """End an idle process, or wait for the end of one that was asked; one that was stopped (SIGSTOP) is killed."""
        manager, processes = self._executor._executor_manager_thread, self._processes
        self._executor.shutdown(wait=False, cancel_futures=True)
        if manager is not None:
            manager.join(GRACE_SECONDS)
            if manager.is_alive():
                for process in processes:
                    process.kill()
                manager.join()

    def ask_to_end(self) -> None:
        """Send SIGTERM: a unit that handles it, such as a training, may keep what it has; all others end at once."""
        for process in self._processes:
            process.terminate()
        self._executor.shutdown(wait=False, cancel_futures=True)

    def kill(self, after: float) -> None:
        """Kill the process if it is still there after some seconds."""
        for process in self._processes:
            process.join(after)
            process.kill()
        self.end()


class LocalTeam:
    """Processes of this machine; see `schedule.Team`."""

    def __init__(self, work: bytes) -> None:
        """Hire nobody yet; `work` is pickled."""
        self._work = work
        self._workers: list[LocalWorker] = []
        self._busy: dict[Future[Outcome[Any]], LocalWorker] = {}

    def hire(self) -> LocalWorker:
        """Start a process.

        Raises:
            UserError: the server that forks it was killed several times.
        """
        for _ in range(_SERVERS_ALLOWED):
            worker = LocalWorker(self._work)
            # Ours before it starts: an interruption in the midst leaves none that nobody ends.
            self._workers.append(worker)
            try:
                worker.start()
            except (EOFError, ConnectionError):  # the next one has a new server
                self._workers.remove(worker)
                continue
            return worker
        raise UserError("workers cannot start: what forks them is killed each time; run the same command again")

    def give(self, worker: LocalWorker, unit: Any) -> bool:
        """Give a unit to an idle worker; return False where it has died."""
        try:
            self._busy[worker.submit(unit)] = worker
        except BrokenProcessPool:
            self.dismiss(worker)
            return False
        return True

    def wait(self) -> list[tuple[LocalWorker, Outcome[Any] | None]]:
        """Wait until a unit is done or its worker has died."""
        finished, _ = concurrent.futures.wait(self._busy, return_when=concurrent.futures.FIRST_COMPLETED)
        heard: list[tuple[LocalWorker, Outcome[Any] | None]] = []
        for future in finished:
            worker = self._busy.pop(future)
            outcome = worker.outcome(future)
            if isinstance(outcome, Died):
                self._workers.remove(worker)
            heard.append((worker, outcome))
        return heard

    def dismiss(self, worker: LocalWorker) -> None:
        """End an idle worker."""
        self._workers.remove(worker)
        worker.end()

    def close(self) -> None:
        """End all; what still works is asked first, and killed after a while or a second interruption."""
        busy, workers = set(self._busy.values()), self._workers
        self._workers, self._busy = [], {}
        until = time.monotonic() + GRACE_SECONDS
        try:
            for worker in busy:
                worker.ask_to_end()
            for worker in workers:
                worker.kill(max(until - time.monotonic(), 0.0)) if worker in busy else worker.end()
        except KeyboardInterrupt:
            for worker in workers:
                worker.kill(0.0)
            raise


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block SIGINT: a process that is started now never sees a Ctrl-C, which is for the parent to answer."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _how(exit_code: int | None) -> str:
    if exit_code is None:
        return "its process ended"
    if exit_code < 0:
        return f"killed by {signal.Signals(-exit_code).name}"
    if exit_code == _NOT_BEGUN:
        return "could not begin: too little memory or too many processes"
    return f"exit code {exit_code}"


def _begin(work: bytes, environment: dict[str, str]) -> None:
    """Begin a worker process."""
    global _bench
    os.environ.clear()
    os.environ.update(environment)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.path.append(str(Path.cwd()))  # for modules that the user names, at the end so that none is shadowed
    try:
        threading.Thread(target=_end_with_parent, daemon=True).start()
    except RuntimeError:  # no thread can be had; the executor would print a traceback
        os._exit(_NOT_BEGUN)
    _bench = Bench(lambda: pickle.loads(work), lambda folder: folder, pickle.loads)
    multiprocessing.util.Finalize(None, _bench.close, exitpriority=0)


def _end_with_parent() -> None:
    """End this process when the parent is gone, however: its executor would wait for units for ever.

    A unit that handles SIGTERM has a moment to keep what it has.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(ORPHAN_SECONDS)
    os._exit(1)


class _Packed:
    """A unit that arrives as bytes.

    What fails while it is unpickled, and modules are imported for it, fails as the unit does. The executor would end
    the worker with a traceback.
    """

    def __init__(self, unit: Any) -> None:
        self._unit = unit

    def __reduce__(self) -> tuple[Any, ...]:
        return bytes, (pickle.dumps(self._unit),)


def _do(packed: bytes) -> Outcome[Any]:
    assert _bench is not None
    return _bench.do(packed)
