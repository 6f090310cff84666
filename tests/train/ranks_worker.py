"""What a rank of the tests does: it trains some estimators and notes every sample that it trained on.

`python ranks_worker.py FOLDER SHARDS ALGO...`; started by `torchrun`, or alone.
"""

import dataclasses
import hashlib
import json
import sys
from pathlib import Path

from torch import Tensor

from graspq.train import estimators
from graspq.train.batch import Batch
from graspq.train.distributed import Ranks, joined
from graspq.train.estimators import Estimator
from graspq.train.loop import train
from graspq.train.settings import preset_settings
from graspq.train.state import Context, TrainState
from graspq.train.updates import Update

STEPS = 4


def train_all(folder: Path, shards: str, names: list[str], ranks: Ranks) -> None:
    """Train each estimator without a break into `unbroken`, ranks also with one into `broken`, and note its samples."""
    runs = {"unbroken": (STEPS,), "broken": (2, STEPS)} if ranks.count > 1 else {"unbroken": (STEPS,)}
    for name in names:
        row, seen = estimators.ESTIMATORS[name], list[list[str]]()
        estimators.ESTIMATORS[name] = dataclasses.replace(row, update=noting(row, seen))
        try:
            for run, stops in runs.items():
                for stop in stops:
                    train_until(stop, folder / run / name, shards, name, ranks)
        finally:
            estimators.ESTIMATORS[name] = row
        (folder / f"{name}-{ranks.rank}.json").write_text(json.dumps(seen[:STEPS]))


def train_until(step: int, out: Path, shards: str, name: str, ranks: Ranks) -> None:
    settings = preset_settings(
        "default",
        algo=name,
        shards=(shards,),
        out=out,
        steps=20,
        batch_size=31,  # odd: the parts of the ranks are not equal
        action_noise=0.1,
        learning_rate=1e-3,
        warmup=0.0,
        lag_steps=2,
        actor_rest=0.0,
        precision="float32",
        device="cpu",
        threads=1,
        log_every=1,
    )
    train(settings, stop_at=step, ranks=ranks)


def noting(row: Estimator, seen: list[list[str]]) -> Update:
    """Return the update of the row, which also notes a digest of every real step's augmented image and action."""

    def update(state: TrainState, batch: Batch, estimator: Estimator, context: Context) -> Tensor:
        steps = zip(batch.real(batch.image), batch.real(batch.action), strict=True)
        contents = (image.contiguous().numpy().tobytes() + action.numpy().tobytes() for image, action in steps)
        seen.append([hashlib.sha256(content).hexdigest() for content in contents])
        return row.update(state, batch, estimator, context)

    return update


if __name__ == "__main__":
    with joined("cpu") as met:
        train_all(Path(sys.argv[1]), sys.argv[2], sys.argv[3:], met)
