"""Imports PyBullet without the line about its build that it prints on standard output."""

import os
import sys

sys.stdout.flush()
_stdout = os.dup(1)
_null = os.open(os.devnull, os.O_WRONLY)
os.dup2(_null, 1)
try:
    import pybullet as bullet
finally:
    os.dup2(_stdout, 1)
    os.close(_stdout)
    os.close(_null)

__all__ = ["bullet"]
