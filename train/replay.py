"""Takes the first steps of a run again, from its `config.json` alone, and compares the metrics with those it recorded.

The same machine and number of threads give the same bits; elsewhere sums are rounded in another order.
"""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from graspq.common.errors import UserError, said_of
from graspq.common.files import temporary_folder
from graspq.datasets.dataset import open_shards
from graspq.train.loop import train
from graspq.train.run import Run
from graspq.train.settings import TrainSettings

REPLAYED_STEPS = 100
TOLERANCE = 1e-3  # relative
_OF_THE_MACHINE = ("samples_per_second",)


@dataclasses.dataclass(frozen=True)
class Replay:
    """What came of it.

    Attributes:
        steps: of the rows of metrics that were compared.
        values: number of values that were compared.
        largest: largest relative difference, |replayed − recorded| / |recorded|.
        where: step and name of that value.
    """

    steps: tuple[int, ...]
    values: int
    largest: float
    where: tuple[int, str]

    @property
    def holds(self) -> bool:
        """Whether all values are the recorded ones, up to `TOLERANCE`."""
        return self.largest <= TOLERANCE

    def line(self) -> str:
        """Return the outcome in one line."""
        step, name = self.where
        what = f"{self.values} recorded values of steps {', '.join(map(str, self.steps))}"
        if self.largest == 0.0:
            return f"{what} are the same bit for bit"
        fit = f"fit within {TOLERANCE:g}" if self.holds else f"do not fit within {TOLERANCE:g}"
        return f"{what} {fit}: the largest difference is {self.largest:.2g}, of {name} at step {step}"


def replay(
    folder: Path, *, shards: Sequence[str] = (), threads: int | None = None, show_progress: bool = False
) -> Replay:
    """Train the first `REPLAYED_STEPS` steps of a run again, in a temporary folder, and compare the metrics.

    Args:
        folder: the run; only its `config.json` and `metrics.jsonl` are read.
        shards: where its data lie, if not where the run has them.
        threads: of torch, if not as many as the run says.
        show_progress: show a progress bar on standard error.

    Raises:
        UserError: there is no run of grasp-train, it recorded nothing of these steps, or its data are not there.
    """
    run = Run.open(folder)
    if "online" in run.config:
        raise UserError(f"{folder}: a run of grasp-online, whose data grow; name one of grasp-train")
    recorded = _rows(run)
    if not recorded:
        raise UserError(f"{folder}: has no metrics of its first {REPLAYED_STEPS} steps; let grasp-train run on")
    with said_of(run.folder / "config.json"):
        settings = TrainSettings.from_json(run.config["settings"])
    changed: dict[str, Any] = {"shards": tuple(shards)} if shards else {}
    changed |= {"threads": threads} if threads is not None else {}
    settings = dataclasses.replace(settings, **changed)
    there, wanted = open_shards(settings.shards, verify=False).manifest_digest, run.config["dataset"]["manifest_sha256"]
    if there != wanted:
        raise UserError(
            f"{' '.join(settings.shards)}: not the data of {folder} (digest {there[:16]}, expected {wanted[:16]}); "
            "name them with --shards"
        )
    with temporary_folder("replay") as temporary:
        again = dataclasses.replace(settings, out=temporary / "run")
        replayed = _rows(train(again, stop_at=REPLAYED_STEPS, show_progress=show_progress))
    return compared(recorded, replayed)


# By the steps that they are the means of: the one before the first, the last.
Rows = dict[tuple[int, int], dict[str, float]]


def _rows(run: Run) -> Rows:
    """Return the rows of training of the first steps."""
    rows, before = Rows(), 0
    for row in run.metrics():
        if "loss" in row and row["step"] <= REPLAYED_STEPS:
            values = {name: value for name, value in row.items() if name not in ("step", *_OF_THE_MACHINE)}
            rows[before, row["step"]] = values
            before = row["step"]
    return rows


def compared(recorded: Rows, replayed: Rows) -> Replay:
    """Compare the rows that are of the same steps; a run that was stopped has others there.

    What one side lacks of a row differs without bound, and so do runs without such rows.
    """
    same = sorted(recorded.keys() & replayed.keys())
    found = [
        (_difference(recorded[steps].get(name), replayed[steps].get(name)), (steps[1], name))
        for steps in same
        for name in sorted(recorded[steps].keys() | replayed[steps].keys())
    ]
    largest, where = max(found, default=(math.inf, (0, "nothing")))
    return Replay(tuple(step for _, step in same), len(found), largest, where)


def _difference(recorded: float | None, replayed: float | None) -> float:
    if recorded is None or replayed is None:
        return math.inf
    return 0.0 if recorded == replayed else abs(replayed - recorded) / max(abs(recorded), 1e-12)
