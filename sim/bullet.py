"""Imports PyBullet without the line about its build that it prints on every import."""

import os

_NULL = os.open(os.devnull, os.O_WRONLY)
_SAVED = {stream: os.dup(stream) for stream in (1, 2)}
for _stream in _SAVED:
    os.dup2(_NULL, _stream)
try:
    import pybullet as bullet
finally:
    for _stream, _copy in _SAVED.items():
        os.dup2(_copy, _stream)
        os.close(_copy)
    os.close(_NULL)

__all__ = ["bullet"]
