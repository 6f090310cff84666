"""The cell is mirror-symmetric about y = 0, so a mirrored picture with mirrored actions is valid data."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from graspq.objects.third_party import import_meshes
from graspq.sim.episode import GraspSimulation
from graspq.sim.task import TASKS

MIRROR = np.array([1.0, -1.0, 1.0, -1.0])
PLACES = [(0.60, 0.05, 0.4), (0.47, -0.06, -0.9), (0.52, 0.09, 1.3)]
ACTIONS = [[0.7, 0.5, -1, 0.7], [-0.3, 0.8, -0.6, -1], [0.4, -1, -0.8, 0.4], [0.2, 0.3, -1, 0]]


@pytest.fixture(scope="module")
def boxes(tmp_path_factory):
    source = tmp_path_factory.mktemp("boxes")
    for index, sides in enumerate([(0.03, 0.05, 0.04), (0.035, 0.08, 0.03), (0.04, 0.045, 0.06)]):
        trimesh.creation.box(sides).export(source / f"box_{index}.obj")
    return import_meshes(source, source.parent / "box_set")


def play(boxes, mirrored):
    sign = MIRROR if mirrored else np.ones(4)
    frames, poses, objects = [], [], []
    with GraspSimulation(TASKS["regular"], boxes) as simulation:
        simulation.load([record.object_id for record in boxes.objects])
        simulation.reset(np.random.default_rng(0))
        for body, (x, y, yaw) in zip(simulation.bodies, PLACES, strict=True):
            body.set_pose((x, sign[1] * y, 0.032), Rotation.from_euler("z", sign[3] * yaw).as_quat())
        simulation.world.step(120)
        simulation._observation = None
        frames.append(simulation.observation.image)
        for action in ACTIONS:
            observation = simulation.step(np.array(action) * sign).observation
            frames.append(observation.image)
            poses.append(observation.gripper_pose * sign)
            objects.append(simulation.object_poses()[:, :3] * sign[:3])
    if mirrored:
        frames = [frame[:, ::-1] for frame in frames]
    return np.stack(frames).astype(int), np.stack(poses), np.stack(objects)


def test_mirrored_actions_in_a_mirrored_scene_give_mirrored_poses_and_frames(boxes):
    frames, poses, objects = play(boxes, mirrored=False)
    mirrored_frames, mirrored_poses, mirrored_objects = play(boxes, mirrored=True)
    assert np.abs(poses - mirrored_poses)[:, :3].max() < 0.5e-3, "gripper, metres"
    assert np.abs(poses - mirrored_poses)[:, 3].max() < 2e-3, "gripper, radians"
    assert np.abs(objects - mirrored_objects)[:-1].max() < 1e-3, "objects before the grasp, metres"
    difference = np.abs(frames - mirrored_frames)[:-1]
    assert difference[0].max() == 0, "before the arm moves, the mirrored picture"
    assert difference.mean() < 0.1, "grey levels"
    assert (difference.max(axis=-1) > 12).mean() < 0.002, "share of pixels, where motors left the arm elsewhere"


def test_without_mirroring_the_frames_differ_much_more(boxes):
    frames, _, _ = play(boxes, mirrored=False)
    assert np.abs(frames - frames[:, :, ::-1])[:-1].mean() > 5
