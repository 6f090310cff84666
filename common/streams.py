"""What a command is started with: standard streams, a working folder, a keyboard. None of them may cost a result."""

import contextlib
import os
import select
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType, TracebackType

import click

from graspq.common.errors import UserError

_OUTPUTS = {1: "stdout", 2: "stderr"}


def whole_streams() -> None:
    """See to it that the three standard streams are there and take any text.

    Where one is closed, the null device takes its place, and its descriptor too: else the next file to be opened would
    have that descriptor, and what libraries print would land in the file. A character that a terminal cannot show is
    written as its code.
    """
    for number, name in {0: "stdin", **_OUTPUTS}.items():
        try:
            os.fstat(number)
        except OSError:
            # The lowest descriptor that is free, and those below this one are not.
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, Path(os.devnull).open("r" if number == 0 else "w"))  # noqa: SIM115
        elif number in _OUTPUTS and hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def readers_are_gone() -> bool:
    """Return whether nobody reads standard output or standard error any more, as in `... | head -1`."""
    watched = select.poll()
    for number in _OUTPUTS:
        with contextlib.suppress(OSError):
            os.fstat(number)
            watched.register(number, 0)
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in watched.poll(0))


def give_up_streams() -> None:
    """Send what is still to be written to the null device, so that the end of the process does not fail on it."""
    null = os.open(os.devnull, os.O_WRONLY)
    for number in _OUTPUTS:
        os.dup2(null, number)
    os.close(null)


def require_names_of_text(words: Sequence[str]) -> None:
    """Refuse a working folder that is gone, and names of files that are no UTF-8: no JSON could hold them.

    Args:
        words: of the command line.

    Raises:
        UserError: see the message.
    """
    try:
        folder = str(Path.cwd())
    except OSError as error:
        raise UserError(f"the working folder is gone ({error.strerror}); change to another folder") from None
    for word in (*words, folder):
        try:
            word.encode()
        except UnicodeEncodeError:
            raise UserError(f"{os.fsencode(word)!r}: a name that is no text (UTF-8); rename it") from None


def next_interrupt_ends_at_once() -> None:
    """Let another Ctrl-C end this process without a word: it is ending, and nobody would catch it."""
    usual = signal.getsignal(signal.SIGINT) in (signal.default_int_handler, _interrupt)
    if threading.current_thread() is threading.main_thread() and usual:
        signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextlib.contextmanager
def ended_in_order() -> Iterator[None]:
    """Let SIGTERM, as schedulers and containers send it, raise KeyboardInterrupt here, as a Ctrl-C does.

    So workers are ended and folders removed. Without effect where somebody handles it.
    """
    ours = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    if ours:
        signal.signal(signal.SIGTERM, _interrupt)
    try:
        yield
    finally:
        if ours:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def interrupts_without_traceback() -> None:
    """Let a Ctrl-C while a script of ours is still importing say one word, as later on."""
    sys.excepthook = _say_interrupted
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)


def _say_interrupted(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if issubclass(kind, KeyboardInterrupt) or was_interrupted():
        click.echo("interrupted", err=True)
    else:
        sys.__excepthook__(kind, error, trace)


_signals: list[int] = []


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt and note it: a library that is importing may swallow that, and break on it later."""
    _signals.append(number)
    signal.default_int_handler(number, frame)


def was_interrupted() -> bool:
    """Return whether this process was asked to end, so that what fails now fails for that."""
    return bool(_signals)
