"""What this process may use of the machine."""

import contextlib
import os
import sys
from collections.abc import Iterator


def available_cores() -> int:
    """Return the number of cores this process may run on, at least 1."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Let PyTorch, where the policy has imported it, compute in one thread.

    The workers keep the cores busy, so threads of one decision would wait for each other; and rounding does not depend
    on the number of cores.
    """
    if "torch" not in sys.modules:
        yield
        return
    import torch

    usual = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(usual)
