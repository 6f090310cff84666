"""Drawn data for the benchmarks of loading and training."""

import sys
from pathlib import Path

import pytest
import torch

from graspq.datasets.dataset import open_shards
from graspq.datasets.pool import ShardPool

sys.path.append(str(Path(__file__).resolve().parents[1] / "datasets"))


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> None:
    """Other processes share the machine."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def shards(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Sixty drawn episodes in three shards."""
    from drawn_data import make_dataset

    folder = tmp_path_factory.mktemp("data") / "drawn"
    make_dataset(folder, blocks=30, per_shard=10)
    return str(folder)


@pytest.fixture(scope="session")
def pool(shards: str) -> ShardPool:
    return open_shards([shards])
