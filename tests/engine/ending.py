"""A process that hands out work is ended, and what it leaves is looked for."""

import contextlib
import os
import subprocess
import sys
import time
from pathlib import Path


def opened(notes):
    """Return the ids of the processes that opened a work."""
    return {path.name.split("-")[1] for path in notes.glob("open-*")}


def alive(mark):
    """Return the processes that were started with this in their environment, or have a file open below a folder of it.

    In a container nobody may fetch the status of one that has ended (Z).
    """
    found, folder = [], mark.partition("=")[2]
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            marked = mark.encode() in (process / "environ").read_bytes()
            writes = any(folder in str(path.readlink()) for path in (process / "fd").iterdir())
            if (marked or writes) and "State:\tZ" not in (process / "status").read_text():
                found.append(process.name)
    return found


def end_in_the_middle(engine, number, folder):
    """Start `driver.py`, send it a signal when two workers work, and check that nothing is left soon after."""
    notes, temporary = folder / "notes", folder / "t"
    notes.mkdir()
    temporary.mkdir()
    mark = f"MARK={folder}"
    driver = [sys.executable, Path(__file__).with_name("driver.py"), engine, notes]
    with subprocess.Popen(
        driver,
        env={**os.environ, "TMPDIR": str(temporary), "MARK": str(folder)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as parent:
        while len(list(notes.glob("unit-*"))) < 2:
            assert parent.poll() is None
            time.sleep(0.05)
        parent.send_signal(number)
        parent.wait()
    until = time.monotonic() + 20  # 5 on a machine of one's own
    while (alive(mark) or list(temporary.iterdir())) and time.monotonic() < until:
        time.sleep(0.05)
    assert len(opened(notes)) == 2 and not alive(mark)
    assert not list(temporary.iterdir())
