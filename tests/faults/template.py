"""A process that has imported every command and forks one for each request: a fault does not pay for Python's start.

Started with `lean`, it leaves the largest of what they import late to the commands, which then ask for that memory.

Requests and answers are lines of JSON on the standard input and output that it is started with; see `Request`.
"""

import atexit
import contextlib
import ctypes
import gc
import importlib
import json
import os
import resource
import runpy
import select
import signal
import sys
import tempfile
import threading
import time
import traceback
from typing import Any, NoReturn

COMMANDS = {
    "grasp-objects": "graspq.objects.cli",
    "grasp-datagen": "graspq.datagen.cli",
    "grasp-data": "graspq.datasets.cli",
    "grasp-train": "graspq.train.cli",
    "grasp-online": "graspq.studies.online.cli",
    "grasp-eval": "graspq.evaluate.cli",
    "grasp-sweep": "graspq.studies.sweep.cli",
    "grasp-study": "graspq.studies.study.cli",
    "grasp-report": "graspq.report.cli",
}
# What the commands import late.
LATE = (
    "graspq.objects.procedural", "graspq.datagen.making", "graspq.train.loop", "graspq.evaluate.evaluation",
    "graspq.policies.of_run", "graspq.studies.online.rounds", "graspq.studies.sweep.workers",
    "graspq.studies.sweep.table", "graspq.studies.study.study", "graspq.studies.study.publishing",
    "graspq.report.page", "torch.utils.tensorboard", "graspq.evaluate.over_seeds",
)  # fmt: skip
# The same, not when lean. An optimizer of PyTorch imports `torch._dynamo` when it is first made, and a table of PyArrow
# pandas: that takes longer than the small work of a fault.
HEAVY = (
    "torch._dynamo", "pandas", "matplotlib.backends.backend_agg", "PIL.PngImagePlugin", "PIL.PpmImagePlugin",
    "PIL.BmpImagePlugin", "PIL.GifImagePlugin", "PIL.JpegImagePlugin", "graspq.evaluate.job_units",
    "graspq.datasets.verify",
)  # fmt: skip
Request = dict[str, Any]  # argv, cwd, env, stdin, stdout, stderr (paths), seconds, limits (name -> bytes), armed


def main() -> None:
    """Answer requests until there are no more."""
    sys.path.pop(0)  # this folder: names of ours must hide nobody's
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a terminal, which is for who started this
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    requests, answers = os.fdopen(os.dup(0)), os.fdopen(os.dup(1), "w")
    nothing = os.open(os.devnull, os.O_RDWR)
    os.dup2(nothing, 0)
    os.dup2(nothing, 1)
    for name in (*COMMANDS.values(), *LATE, *(() if sys.argv[1:] == ["lean"] else HEAVY)):
        importlib.import_module(name)
    importlib.import_module("graspq.common.provenance").code_revision()
    gc.collect()
    gc.freeze()  # a child that collects garbage need not go through, and so copy, all that was imported
    print("ready", file=answers, flush=True)
    with contextlib.suppress(SystemExit):
        for line in requests:
            print(json.dumps(_answer(json.loads(line))), file=answers, flush=True)
    os._exit(0)  # nothing is left to do


def _answer(request: Request) -> dict[str, Any]:
    start = time.monotonic()
    child = os.fork()
    if child == 0:
        _be(request)
    ended = os.pidfd_open(child)
    try:
        with contextlib.closing(os.fdopen(ended)):
            hung = not select.select([ended], [], [], request["seconds"])[0]
    except SystemExit:
        _kill_group(child)
        raise
    # The child leads a group of its own: what it has started ends with it.
    if hung:
        _kill_group(child)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    _kill_group(child)
    return {"rc": status, "hung": hung, "seconds": time.monotonic() - start}


def _kill_group(leader: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(leader, signal.SIGKILL)


def _be(request: Request) -> NoReturn:
    """Become the process of a command; it ends as the command would."""
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    importlib.import_module("graspq.common.streams").interrupts_without_traceback()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    tempfile.tempdir = None
    for number, name, flags in (
        (0, "stdin", os.O_RDONLY),
        (1, "stdout", os.O_WRONLY | os.O_CREAT | os.O_TRUNC),
        (2, "stderr", os.O_WRONLY | os.O_CREAT | os.O_TRUNC),
    ):
        opened = os.open(request[name], flags, 0o644)
        os.dup2(opened, number)
        os.close(opened)
    program, *arguments = sys.argv = list(request["argv"])
    for name, limit in request["limits"].items():
        resource.setrlimit(getattr(resource, name), (limit, limit))
    if request["armed"] is not None:
        _arm(**request["armed"])
    status = 0
    try:
        if program in COMMANDS:
            importlib.import_module(COMMANDS[program]).main(arguments, prog_name=program)
        else:
            runpy.run_path(program, run_name="__main__")
    except SystemExit as ending:
        status = _status(ending.code)
    except BaseException:
        traceback.print_exc()
        status = 1
    _end(status)


def _status(code: object) -> int:
    """Return the exit status that Python makes of the value of a SystemExit."""
    if code is None or isinstance(code, int):
        return (code or 0) & 0xFF
    print(code, file=sys.stderr)
    return 1


def _end(status: int) -> NoReturn:
    """End as Python does: wait for threads, call what asked for it, flush; but do not take all modules apart.

    That last step took a second, most of it to copy the pages of what was imported, and does nothing to files.
    """
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(status)


def _arm(under: str, mode: int, at: int, error: int, log: str, calls: int) -> None:
    """Arm `shim.c`, which this process was started with."""
    arm = ctypes.CDLL(None).graspq_arm
    arm.argtypes = [ctypes.c_char_p, ctypes.c_int, ctypes.c_long, ctypes.c_int, ctypes.c_char_p, ctypes.c_uint]
    arm(under.encode(), mode, at, error, log.encode(), calls)


if __name__ == "__main__":
    main()
