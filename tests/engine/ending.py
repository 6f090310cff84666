"""A process that hands out work is ended, and what it leaves is looked for."""

import os
import subprocess
import sys
import time
from pathlib import Path


def opened(notes):
    """Return the ids of the processes that opened a work."""
    return {path.name.split("-")[1] for path in notes.glob("open-*")}


def alive(notes):
    """Return the workers that run; in a container nobody may fetch the status of one that has ended (Z)."""
    states = [Path("/proc") / pid / "status" for pid in opened(notes)]
    return [state for state in states if state.exists() and "State:\tZ" not in state.read_text()]


def end_in_the_middle(engine, number, folder):
    """Start `driver.py`, send it a signal when two workers work, and check that nothing is left after 5 seconds."""
    notes, temporary = folder / "notes", folder / "t"
    notes.mkdir()
    temporary.mkdir()
    driver = [sys.executable, Path(__file__).with_name("driver.py"), engine, notes]
    with subprocess.Popen(
        driver, env={**os.environ, "TMPDIR": str(temporary)}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as parent:
        while len(list(notes.glob("unit-*"))) < 2:
            assert parent.poll() is None
            time.sleep(0.05)
        parent.send_signal(number)
        parent.wait()
    until = time.monotonic() + 5
    while (alive(notes) or list(temporary.iterdir())) and time.monotonic() < until:
        time.sleep(0.05)
    assert len(opened(notes)) == 2 and not alive(notes)
    assert not list(temporary.iterdir())
