"""Imported first by the server that workers are forked from: takes its socket's folder away when it ends.

Python does so only where the process that started the server ends by itself, not where that is killed.
"""

import atexit
import os
import shutil

FOLDER = "GRASPQ_SERVER_FOLDER"

if FOLDER in os.environ:
    # Not run in workers: a forked process does not go through what was registered before it.
    atexit.register(shutil.rmtree, os.environ.pop(FOLDER), ignore_errors=True)
