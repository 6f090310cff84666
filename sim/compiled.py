"""Functions of numbers and arrays compiled by numba, once for each user and machine: other processes read the result.

No fast-math: the same bytes on every x86-64 machine, whatever its vector units.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import filelock
import numba

from graspq.common.files import cache_folder

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(signature: str) -> Callable[[Function], Function]:
    """Return a decorator that compiles a function for one signature, or reads what another process compiled.

    The result lies in numba's folder (NUMBA_CACHE_DIR) if one is set, else in the user's cache of graspq. Processes
    that start together wait for the first of them.

    Args:
        signature: numba's types of the result and the arguments, such as `"void(f8[:, ::1])"`.
    """

    def compile_or_load(function: Function) -> Function:
        folder = cache_folder("numba")
        folder.mkdir(parents=True, exist_ok=True)
        given = numba.config.CACHE_DIR
        numba.config.CACHE_DIR = given or str(folder)
        try:
            with filelock.FileLock(folder / f"{function.__name__}.lock"):
                made: Function = numba.njit(signature, cache=True, fastmath=False, error_model="numpy")(function)
        finally:
            numba.config.CACHE_DIR = given
        return made

    return compile_or_load


def part_of_compiled(function: Function) -> Function:
    """Let compiled functions of the same file call this one; it is compiled with them."""
    made: Function = numba.njit(error_model="numpy")(function)
    return made
