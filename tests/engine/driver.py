"""Hands out units that sleep, in a process that a test then kills: `driver.py ENGINE NOTES`."""

import sys
from pathlib import Path

from units_of_work import Squares

from graspq.engine import EngineSettings, run

if __name__ == "__main__":
    print("begun", flush=True)
    settings = EngineSettings(engine=sys.argv[1], workers=2)
    for unit, _ in run(Squares(Path(sys.argv[2])), [0, *[("sleep", 60)] * 3], settings):
        print(unit, flush=True)
