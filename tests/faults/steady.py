"""One process that collects, trains and evaluates whenever a line comes, and says what memory and handles it holds."""

import contextlib
import gc
import io
import json
import resource
import shutil
import sys
from pathlib import Path

from graspq.datagen.making import make_dataset
from graspq.datagen.settings import DatagenSettings
from graspq.datasets.verify import verify
from graspq.engine import EngineSettings
from graspq.evaluate.rollout import Rollouts, run_rollouts
from graspq.evaluate.scenes import Scenes
from graspq.policies.of_run import load
from graspq.sim.task import TASKS
from graspq.train.loop import train
from graspq.train.settings import complete


def cycle(folder: Path) -> None:
    """Do a little of everything, anew."""
    shutil.rmtree(folder, ignore_errors=True)
    objects = Path("objects")
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        make_dataset(DatagenSettings(size=40, seed=6, out=folder / "data", objects=objects, workers=1))
    assert not verify(folder / "data").faults
    small = {"width": 4, "batch_size": 8, "save_every": 5, "steps": 10, "device": "cpu", "threads": 1}
    chosen = {"algo": "mc", "shards": (str(folder / "data"),), "out": folder / "run", "validation_fraction": 0.3}
    run = train(complete(small | chosen, "paper"))
    scenes = Scenes(TASKS["regular"], objects, "validation", 0)
    run_rollouts(Rollouts(scenes, load(run.folder)), 4, EngineSettings(workers=1))


if __name__ == "__main__":
    for _ in sys.stdin:
        cycle(Path("steady"))
        gc.collect()
        statm = Path("/proc/self/statm").read_text().split()
        held = {
            "memory_kb": int(statm[1]) * resource.getpagesize() // 1024,
            "handles": sum(1 for _ in Path("/proc/self/fd").iterdir()),
            "threads": sum(1 for _ in Path("/proc/self/task").iterdir()),
            "peak_kb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        }
        print(json.dumps(held), flush=True)
