import numpy as np
import pytest

from graspq.sim import kinematics, robot_model
from graspq.sim.bullet import bullet

POSES = [(0.55, 0.0, 0.28, 0.0), (0.42, 0.13, 0.1, 1.2), (0.68, -0.13, 0.015, -1.7), (0.45, 0.0, 0.55, 0.0)]


@pytest.fixture(scope="module")
def panda():
    client = bullet.connect(bullet.DIRECT)
    yield client, bullet.loadURDF(str(robot_model.panda_urdf()), useFixedBase=True, physicsClientId=client)
    bullet.disconnect(client)


@pytest.mark.parametrize("pose", POSES)
def test_the_simulators_forward_kinematics_lead_back_to_the_pose(panda, pose):
    client, body = panda
    for joint, angle in enumerate(kinematics.joint_angles(*pose)):
        bullet.resetJointState(body, joint, angle, physicsClientId=client)
    state = bullet.getLinkState(body, 11, computeForwardKinematics=1, physicsClientId=client)
    rotation = np.array(bullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)
    np.testing.assert_allclose(state[4], pose[:3], atol=1e-6)
    np.testing.assert_allclose(rotation[:, 2], [0, 0, -1], atol=1e-6)
    closing = [np.sin(pose[3]), -np.cos(pose[3]), 0.0]
    np.testing.assert_allclose(rotation[:, 1], closing, atol=1e-6)


def test_every_pose_of_the_workspace_keeps_within_the_joint_limits(panda):
    client, body = panda
    limits = [bullet.getJointInfo(body, joint, physicsClientId=client)[8:10] for joint in range(7)]
    for x in (0.42, 0.55, 0.68):
        for y in (-0.13, 0.0, 0.13):
            for z in (0.015, 0.28, 0.49):
                for phi in (-1.75, 0.0, 1.75):
                    for angle, (low, high) in zip(kinematics.joint_angles(x, y, z, phi), limits, strict=True):
                        assert low < angle < high


def test_a_mirrored_pose_has_mirrored_joint_angles():
    angles = np.array(kinematics.joint_angles(0.5, 0.1, 0.2, 0.7))
    mirrored = np.array(kinematics.joint_angles(0.5, -0.1, 0.2, -0.7))
    angles[6], mirrored[6] = angles[6] - kinematics.HAND_MOUNT, mirrored[6] - kinematics.HAND_MOUNT
    np.testing.assert_allclose(mirrored, angles * [-1, 1, 1, 1, 1, 1, -1], atol=1e-12)


def test_the_turn_is_read_back_from_the_joints():
    angles = kinematics.joint_angles(0.5, 0.1, 0.2, 1.3)
    assert kinematics.wrist_turn(angles[0], angles[6]) == pytest.approx(1.3, abs=1e-12)


def test_a_pose_out_of_reach_is_refused():
    with pytest.raises(ValueError, match="out of the arm's reach"):
        kinematics.joint_angles(1.2, 0.0, 0.1, 0.0)
