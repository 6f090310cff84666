"""Parts of a benchmark that play in processes of their own, ready before the clock starts.

A part is a generator function: what it yields first says that it is ready; then every message that it is sent asks for
one result. Rivals so share neither a physics client, nor caches, nor settings of PyTorch.
"""

import multiprocessing
import signal
import traceback
from collections.abc import Callable, Generator
from types import TracebackType
from typing import Any

import click

Part = Callable[..., Generator[Any, Any, None]]


class Player:
    """A process that plays a part; use it in a `with` statement."""

    def __init__(self, part: Part, *arguments: Any) -> None:
        # Spawned, not forked: a fork would copy threads' locks and physics clients.
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_play, args=(theirs, part, arguments), daemon=True)
        self._process.start()
        theirs.close()
        self.results: list[Any] = []

    def ask(self, message: Any = None) -> None:
        """Ask for a result, without waiting for it."""
        self._connection.send(message)

    def answer(self) -> Any:
        """Wait for the next result; the first one says that the player is ready.

        Raises:
            click.ClickException: the player failed.
        """
        try:
            result, problem = self._connection.recv()
        except EOFError:
            raise click.ClickException("a process of the benchmark died; its last words are above") from None
        if problem is not None:
            raise click.ClickException(problem)
        return result

    def play(self, message: Any = None) -> None:
        """Ask for a result, wait for it and keep it in `results`."""
        self.ask(message)
        self.results.append(self.answer())

    def __enter__(self) -> "Player":
        self.answer()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._connection.close()
        self._process.terminate()
        self._process.join()


def _play(connection: Any, part: Part, arguments: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends us
    try:
        playing = part(*arguments)
        connection.send((next(playing), None))
        while True:
            connection.send((playing.send(connection.recv()), None))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return  # the parent is gone
    except click.ClickException as error:
        connection.send((None, error.message))
    except Exception as error:
        traceback.print_exc()
        connection.send((None, f"{type(error).__name__}: {error}"))
