import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from graspq.common.action_space import grasping
from graspq.datasets.episode import Episode
from graspq.datasets.manifest import Manifest
from graspq.datasets.writer import commit_shard, write_shard

SCRIPT = Path(__file__).parents[2] / "examples/train_by_hand.py"


def bright_is_success(number):
    """An episode of two steps that succeeds where its images are bright."""
    rng = np.random.default_rng(number)
    success = bool(number % 2)
    return Episode(
        episode_id=number,
        block=number // 2,
        seed=number,
        object_ids=("train_001",),
        object_poses=np.zeros((1, 7), np.float32),
        images=(rng.integers(0, 60, (2, 16, 16, 3)) + 180 * success).astype(np.uint8),
        actions=rng.uniform(-1, 1, (2, 4)).astype(np.float32),
        rewards=np.array([0, success], np.float32),
        gripper_poses=np.zeros((2, 4), np.float32),
        final_pose=np.zeros(4, np.float32),
        ended_by="height",
        success=success,
        lifted_object="train_001" if success else None,
        policy="random",
        exploration=1.0,
        final_image=np.zeros((16, 16, 3), np.uint8),
    )


def test_thirty_lines_of_plain_pytorch_learn_to_tell_successes(tmp_path):
    manifest = Manifest(
        task={"name": "bright", "max_steps": 15},
        settings={"seed": 0, "block_size": 2},
        versions={},
        object_set={"name": "drawn", "sha256": "0" * 64},
        image_shape=(16, 16, 3),
        action=grasping((0.06, 0.06, 0.06, 0.4)),
        discount=1.0,
    )
    episodes = [bright_is_success(number) for number in range(100)]
    commit_shard(tmp_path, manifest, write_shard(tmp_path, manifest, 0, 50, episodes))
    done = subprocess.run(
        [sys.executable, SCRIPT, tmp_path, "101"],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    errors = [float(line.rsplit(" ", 1)[1]) for line in done.stdout.splitlines()]
    assert done.stdout.splitlines()[-1].startswith("held back") and len(errors) == 4
    # The mean of all returns is wrong by 0.25.
    assert errors[-1] < 0.05
