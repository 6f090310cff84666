"""How near training comes to what the machine can compute: its floating-point operations a second against a product's.

    python benchmarks/roofline.py --shards data/regular-10k

Batches lie ready on the device, as where the data are resident. Operations are those that PyTorch counts in one step
(convolutions and matrix products, forward and backward; whatever else a step does counts as nothing), and the roof is
the fastest product of two square matrices in the same precision. Runs on a GPU where there is one.
"""

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import torch
from sessions import default_settings, ready, steps_on
from timing import report, take_turns
from torch.utils.flop_counter import FlopCounterMode

from graspq.common.options import Command
from graspq.datasets.dataset import open_shards
from graspq.train.batch import Batch
from graspq.train.hardware import chosen_device
from graspq.train.loop import Session, session

ALGOS = ("mc", "dql")
SIDES = {"cpu": 2048, "cuda": 8192}


def operations(run: Callable[[], Any]) -> int:
    """Return the floating-point operations of what is run, a multiplication and an addition counting as two."""
    with FlopCounterMode(display=False) as counter:
        run()
    return int(counter.get_total_flops())


def roof(device: torch.device, precision: str, repeats: int = 10) -> float:
    """Return operations a second of the fastest of some products of two square matrices."""
    side = SIDES[device.type]
    one = torch.randn(side, side, device=device, dtype=getattr(torch, precision))
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        (one @ one)[0, 0].item()
        seconds.append(time.perf_counter() - start)
    return 2 * side**3 / min(seconds)


def row_of(current: Session, batches: list[Batch], turns: int) -> dict[str, Any]:
    """Return an estimator's operations a second, and their share of a product's; both take turns."""
    precision, rows = current.precision, current.settings.batch_size
    roofs: list[float] = []
    runs = {
        "step": steps_on(batches, current.update),
        "roof": lambda: roofs.append(roof(precision.device, precision.name)),
    }
    seconds = statistics.median(take_turns(runs, turns)["step"]) / len(batches)
    count, peak = operations(steps_on(batches[:1], current.update)), statistics.median(roofs[1:])
    return {
        "training": current.settings.algo,
        "precision": precision.name,
        "transitions a second": rows / seconds,
        "operations a transition": count / rows,
        "operations a second": count / seconds,
        "a matrix product's": peak,
        "share of the roof": count / seconds / peak,
    }


@click.command(cls=Command)
@click.option("--shards", multiple=True, required=True, help="Dataset folders, shard files or globs.")
@click.option("--device", type=click.Choice(["auto", "cpu", "cuda"]), default="auto", show_default=True, help="Where.")
@click.option("--turns", type=click.IntRange(1), default=5, show_default=True, help="Turns that are measured.")
@click.option("--steps", type=click.IntRange(1), default=6, show_default=True, help="Training steps in a turn.")
@click.option("--threads", type=click.IntRange(1), default=None, help="CPU threads; torch's own choice if not given.")
@click.option("--out", type=click.Path(path_type=Path), default=None, help="JSON file for the figures.")
def main(shards: tuple[str, ...], device: str, turns: int, steps: int, threads: int | None, out: Path | None) -> None:
    """Measure operations a second of training against those of a matrix product."""
    pool = open_shards(shards)
    kept, held_back = pool.split(0.05, 0)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in ALGOS:
            settings = default_settings(name, shards, Path(folder) / name, threads, device)
            with session(settings, pool, kept, held_back) as current:
                rows.append(row_of(current, ready(current, kept, steps), turns))
    used = torch.cuda.get_device_name() if chosen_device(device).type == "cuda" else "CPU"
    facts = {"device": used, "threads": torch.get_num_threads(), "turns": turns, "steps a turn": steps}
    report("Training against the machine's roof", rows, facts, out)


if __name__ == "__main__":
    main()
