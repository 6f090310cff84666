"""Drawn episodes, gradients with a moving square, so that every frame differs from every other, and shards of them."""

import dataclasses
from pathlib import Path

import numpy as np

from graspq.common.action_space import ActionSpace, grasping
from graspq.common.files import sha256_of, write_json, write_text
from graspq.common.seeding import generator
from graspq.datasets.card import write_card
from graspq.datasets.episode import Episode
from graspq.datasets.manifest import FORMAT_VERSION, Manifest
from graspq.datasets.writer import commit_shard, write_shard

LIMITS = (0.06, 0.06, 0.05, 0.7)


# A robot that cannot turn its wrist but tilts and closes its hand, in a scene without a mirror plane.
FIVE_PARTS = ActionSpace(
    names=("dx", "dy", "dz", "tilt", "close"),
    pose=("x", "y", "z", "angle", "width"),
    units=("m", "m", "m", "rad", "m"),
    limits=(0.06, 0.06, 0.05, 0.3, 0.02),
    mirror=None,
    start=(0.0, 0.0, -1.0, 0.0, 0.0),
)


def make_manifest(
    size: int = 8,
    block_size: int = 2,
    discount: float = 1.0,
    task: str = "regular",
    action: ActionSpace | None = None,
    format_version: int = FORMAT_VERSION,
) -> Manifest:
    return Manifest(
        task={"name": task, "max_steps": 15},
        settings={"seed": 0, "block_size": block_size},
        versions={"graspq": "0"},
        object_set={"name": "drawn", "sha256": "0" * 64},
        image_shape=(size, size, 3),
        action=grasping(LIMITS) if action is None else action,
        discount=discount,
        phi_range=(-2.9, 2.9) if action is None else None,
        format_version=format_version,
    )


def make_episode(index: int, block_size: int = 2, size: int = 8, parts: int = 4) -> Episode:
    rng = generator("tests/episode", index)
    steps = int(rng.integers(1, 9))
    y, x = np.mgrid[0:size, 0:size]
    images = np.empty((steps + 1, size, size, 3), np.uint8)
    for step in range(steps + 1):
        images[step] = np.stack([x * 5 + index, y * 7 + step * 11, (x + y) * 3], -1) % 256
        images[step, rng.integers(size), rng.integers(size)] = rng.integers(256, size=3)
        images[step, 0, 0] = (index % 256, index // 256, step)
    success = bool(rng.random() < 0.4)
    rewards = np.zeros(steps, np.float32)
    rewards[-1] = success
    poses = rng.normal(0.3, 0.2, (steps + 1, parts)).astype(np.float32)
    return Episode(
        episode_id=index,
        block=index // block_size,
        seed=int(rng.integers(2**62)),
        object_ids=("train_001", f"train_{index:03d}"),
        object_poses=rng.normal(size=(2, 7)).astype(np.float32),
        images=images[:-1],
        actions=rng.uniform(-1, 1, (steps, parts)).astype(np.float32),
        rewards=rewards,
        gripper_poses=poses[:-1],
        final_pose=poses[-1],
        ended_by="T" if steps == 8 else "height",
        success=success,
        lifted_object="train_001" if success else None,
        policy="random",
        exploration=0.9,
        final_image=images[-1],
    )


def make_episodes(first_block: int, blocks: int, block_size: int = 2, size: int = 8, parts: int = 4) -> list[Episode]:
    first = first_block * block_size
    return [make_episode(index, block_size, size, parts) for index in range(first, first + blocks * block_size)]


def make_dataset(
    folder: Path,
    blocks: int = 12,
    per_shard: int = 5,
    block_size: int = 2,
    size: int = 8,
    discount: float = 1.0,
    action: ActionSpace | None = None,
    format_version: int = FORMAT_VERSION,
) -> Manifest:
    """Write a dataset of real shards, with an object set and a card, and return its manifest."""
    manifest = make_manifest(size, block_size, discount, action=action, format_version=format_version)
    manifest = dataclasses.replace(manifest, object_set=make_objects(folder))
    for first in range(0, blocks, per_shard):
        count = min(per_shard, blocks - first)
        episodes = make_episodes(first, count, block_size, size, manifest.action.size)
        manifest = commit_shard(folder, manifest, write_shard(folder, manifest, first, count, episodes))
    return write_card(folder, manifest)


def make_objects(folder: Path) -> dict[str, str]:
    """Write an object set of one triangle and return its entry for the manifest."""
    mesh = folder / "objects/meshes/train_001.obj"
    write_text(mesh, "o part\nv 0 0 0\nv 0.01 0 0\nv 0 0.01 0\nf 1 2 3\n")
    record = {"object_id": "train_001", "sha256": {"meshes/train_001.obj": sha256_of(mesh)}}
    write_json(folder / "objects/object_set.json", {"name": "drawn", "objects": [record]})
    return {"name": "drawn", "sha256": sha256_of(folder / "objects/object_set.json")}
