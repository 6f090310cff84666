"""What this process may use of the machine."""

import os


def available_cores() -> int:
    """Return the number of cores this process may run on, at least 1."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
