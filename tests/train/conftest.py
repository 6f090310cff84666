"""A tiny decision process with known values, as real shards, and short runs on it.

State A (dark image): an action with dx > 0 leads to state B, any other ends the episode with reward 1 in one of four
cases. State B (bright image): the episode ends with reward 1 where dx > 0, else 0. Actions are uniform.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from graspq.common.action_space import ActionSpace, grasping
from graspq.common.seeding import generator
from graspq.datasets.episode import Episode
from graspq.datasets.manifest import Manifest
from graspq.datasets.writer import commit_shard, write_shard
from graspq.train.settings import TrainSettings, complete

# For `plain`, `tiny_mdp` and `tiny_training`, which hold no tests.
sys.path.append(str(Path(__file__).parent))
SIZE, BLOCK = 16, 10
ACTION = grasping((0.06, 0.06, 0.06, 0.4))
GREY = {"A": 60, "B": 190}


def make_episode(index: int, parts: int = 4) -> Episode:
    rng = generator("tests/train/episode", index)
    actions = rng.uniform(-1, 1, (2, parts)).astype(np.float32)
    steps = 2 if actions[0, 0] > 0 else 1
    success = bool(actions[1, 0] > 0) if steps == 2 else bool(rng.random() < 0.25)
    images = np.empty((steps, SIZE, SIZE, 3), np.uint8)
    for step, state in enumerate("AB"[:steps]):
        images[step] = GREY[state] + rng.integers(-20, 20, (SIZE, SIZE, 3))
    rewards = np.zeros(steps, np.float32)
    rewards[-1] = success
    poses = rng.normal(0.3, 0.2, (steps + 1, parts)).astype(np.float32)
    return Episode(
        episode_id=index,
        block=index // BLOCK,
        seed=index,
        object_ids=("train_001",),
        object_poses=rng.normal(size=(1, 7)).astype(np.float32),
        images=images,
        actions=actions[:steps],
        rewards=rewards,
        gripper_poses=poses[:-1],
        final_pose=poses[-1],
        ended_by="height",
        success=success,
        lifted_object="train_001" if success else None,
        policy="random",
        exploration=1.0,
        final_image=images[-1],
    )


def make_dataset(folder: Path, blocks: int, discount: float = 1.0, action: ActionSpace = ACTION) -> Path:
    manifest = Manifest(
        task={"name": "two-states", "max_steps": 15},
        settings={"seed": 0, "block_size": BLOCK},
        versions={"graspq": "0"},
        object_set={"name": "drawn", "sha256": "0" * 64},
        image_shape=(SIZE, SIZE, 3),
        action=action,
        discount=discount,
        phi_range=(-2.9, 2.9) if action is ACTION else None,
    )
    episodes = [make_episode(index, action.size) for index in range(blocks * BLOCK)]
    commit_shard(folder, manifest, write_shard(folder, manifest, 0, blocks, episodes))
    return folder


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> None:
    """Other processes share the machine, and two runs can then be compared bit by bit."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def two_states() -> SimpleNamespace:
    """What the decision process is made of."""
    return SimpleNamespace(dataset=make_dataset, size=SIZE, grey=GREY)


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of 60 blocks of ten episodes, to read only."""
    return make_dataset(tmp_path_factory.mktemp("data") / "two-states", 60)


@pytest.fixture
def settings(dataset: Path, tmp_path: Path) -> Callable[..., TrainSettings]:
    """Settings of a short run on the dataset, in arithmetic that repeats exactly."""

    def make(algo: str = "mc", preset: Any = "default", **given: Any) -> TrainSettings:
        short = {
            "shards": (str(dataset),),
            "out": tmp_path / "run",
            "steps": 20,
            "batch_size": 32,
            "precision": "float32",
            "device": "cpu",
            "threads": 1,
            "save_every": 10,
        }
        return complete(short | {"algo": algo} | given, preset)

    return make
