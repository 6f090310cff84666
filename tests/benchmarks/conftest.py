"""The benchmarks' scripts are no package: their folder is put on the path, as Python does for a script."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from graspq.common.seeding import generator
from graspq.datasets.dataset import open_shards
from graspq.datasets.episode import Episode
from graspq.datasets.manifest import Manifest
from graspq.datasets.pool import ShardPool
from graspq.datasets.writer import commit_shard, write_shard

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks"))
SIZE, BLOCK, BLOCKS = 8, 2, 30


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> None:
    """Other processes share the machine."""
    torch.set_num_threads(1)


def episode(index: int) -> Episode:
    rng = generator("tests/benchmarks/episode", index)
    steps = int(rng.integers(1, 5))
    rewards = np.zeros(steps, np.float32)
    rewards[-1] = index % 2
    poses = rng.normal(0.3, 0.2, (steps + 1, 4)).astype(np.float32)
    return Episode(
        episode_id=index,
        block=index // BLOCK,
        seed=index,
        object_ids=("train_001",),
        object_poses=rng.normal(size=(1, 7)).astype(np.float32),
        images=rng.integers(0, 256, (steps, SIZE, SIZE, 3), dtype=np.uint8),
        actions=rng.uniform(-1, 1, (steps, 4)).astype(np.float32),
        rewards=rewards,
        gripper_poses=poses[:-1],
        final_pose=poses[-1],
        end="height",
        success=bool(index % 2),
        lifted_object="train_001" if index % 2 else None,
        policy="random",
        exploration=1.0,
    )


@pytest.fixture(scope="session")
def pool(tmp_path_factory: pytest.TempPathFactory) -> ShardPool:
    """Sixty episodes of noise in three shards."""
    folder = tmp_path_factory.mktemp("data") / "noise"
    manifest = Manifest(
        task={"name": "noise", "max_steps": 15},
        settings={"seed": 0, "block_size": BLOCK},
        versions={"graspq": "0"},
        object_set={"name": "drawn", "sha256": "0" * 64},
        image_shape=(SIZE, SIZE, 3),
        action_limits=(0.06, 0.06, 0.06, 0.4),
        discount=1.0,
        phi_range=(-2.9, 2.9),
    )
    for first in range(0, BLOCKS, 10):
        episodes = [episode(index) for index in range(first * BLOCK, (first + 10) * BLOCK)]
        manifest = commit_shard(folder, manifest, write_shard(folder, manifest, first, 10, episodes))
    return open_shards([folder])
