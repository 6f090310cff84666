"""The benchmarks' scripts are no package: their folder is put on the path, as Python does for a script."""

import sys
from pathlib import Path

import pytest
import torch

from graspq.datasets.dataset import open_shards
from graspq.datasets.pool import ShardPool

TESTS = Path(__file__).resolve().parents[1]
sys.path += [str(TESTS.parent / "benchmarks"), str(TESTS / "datasets")]


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> None:
    """Other processes share the machine."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def pool(tmp_path_factory: pytest.TempPathFactory) -> ShardPool:
    """Sixty drawn episodes in three shards."""
    from drawn_data import make_dataset

    folder = tmp_path_factory.mktemp("data") / "drawn"
    make_dataset(folder, blocks=30, per_shard=10)
    return open_shards([folder])
