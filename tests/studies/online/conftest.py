"""A small but real on-policy world: forty random grasps, a run of six steps on them, and plans that go on from it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from graspq.objects.object_set import ObjectSet
from graspq.studies.online.resolve import Plan, resolve
from graspq.train.loop import train
from graspq.train.settings import complete

BLOCKS, BLOCK_SIZE = 8, 5


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> None:
    """Two runs are compared bit by bit."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def base(
    collect_regular: Callable[..., Path], regular_objects: ObjectSet, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Forty grasps of the random policy, with the object set beside them."""
    return collect_regular(tmp_path_factory.mktemp("data") / "base", regular_objects, BLOCKS, BLOCK_SIZE)


@pytest.fixture(scope="session")
def start(base: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of `dql` with a small network, six steps long."""
    folder = tmp_path_factory.mktemp("runs") / "start"
    small = {"batch_size": 8, "width": 8, "average_decay": 0.9, "lag_steps": 4, "validation_fraction": 0.3}
    this = {"algo": "dql", "shards": (str(base),), "out": folder, "steps": 6, "save_every": 3}
    train(complete(this | small | {"device": "cpu", "threads": 1}, "paper"))
    return folder


MakePlan = Callable[..., Plan]


@pytest.fixture(scope="session")
def make_plan(start: Path) -> MakePlan:
    """Return plans of three rounds of two grasps and six steps, simulated in this process."""

    def make(out: Path, **given: Any) -> Plan:
        short = {"start": start, "rounds": 3, "grasps": 2, "steps_per_round": 6, "exploration_steps": 20, "workers": 0}
        return resolve({name: value for name, value in (short | {"out": out} | given).items() if value is not None})

    return make
