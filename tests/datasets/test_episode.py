import dataclasses

import numpy as np
import pytest


def test_an_episode_with_a_wrong_shape_dtype_or_name_is_refused(drawn):
    episode = drawn.episode(7)
    wrong = {
        "images": episode.images.astype(np.float32),
        "actions": episode.actions.astype(np.float64),
        "rewards": episode.rewards[:-1],
        "final_pose": episode.final_pose[:3],
        "object_poses": episode.object_poses[:1],
        "gripper_poses": np.full_like(episode.gripper_poses, np.nan),
        "ended_by": "truncated",
        "final_image": episode.final_image[:4],
        "seed": -1,
    }
    for name, value in wrong.items():
        with pytest.raises(ValueError, match="images|" + name):
            dataclasses.replace(episode, **{name: value})


def test_an_episode_needs_a_step(drawn):
    with pytest.raises(ValueError, match="T ≥ 1"):
        dataclasses.replace(drawn.episode(7), images=np.zeros((0, 8, 8, 3), np.uint8))
