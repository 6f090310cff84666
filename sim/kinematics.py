"""Closed-form kinematics of a Franka Panda whose gripper points straight down.

With the joints 3 and 5 held at zero the arm bends in one vertical plane through its base axis, so each pose of a
vertical gripper has exactly one elbow-up solution: exact, mirror-symmetric about y = 0, and much cheaper than an
iterative solver. Lengths in metres, angles in radians, frames as in the URDF.
"""

import math

SHOULDER_HEIGHT = 0.333
UPPER_ARM, FOREARM, ELBOW_OFFSET = 0.316, 0.384, 0.0825
WRIST_OFFSET = 0.088  # from the axis of joint 6 to that of joint 7
FLANGE_LENGTH = 0.107  # from the axis of joint 6 down to the flange, where the hand begins
HAND_TO_TCP = 0.105  # the tool centre point: between the pads, 7 mm above the finger tips
HAND_MOUNT = math.pi / 4  # the hand is mounted turned by this much about the axis of joint 7

_UPPER = math.hypot(UPPER_ARM, ELBOW_OFFSET)
_FORE = math.hypot(FOREARM, ELBOW_OFFSET)
_UPPER_ANGLE = math.atan2(ELBOW_OFFSET, UPPER_ARM)
_FORE_ANGLE = math.atan2(ELBOW_OFFSET, FOREARM)


def joint_angles(x: float, y: float, z: float, phi: float) -> tuple[float, ...]:
    """Return the seven joint angles that put the tool centre point of the vertical gripper at a pose.

    Args:
        x: metres in the frame of the arm's base.
        y: metres.
        z: metres, height of the tool centre point above the base plane.
        phi: radians, turn of the gripper about the world's z axis; at 0 the fingers close along y.

    Raises:
        ValueError: the pose is out of reach.
    """
    base = math.atan2(y, x)
    wrist_radius = math.hypot(x, y) - WRIST_OFFSET
    wrist_height = z + HAND_TO_TCP + FLANGE_LENGTH - SHOULDER_HEIGHT
    reach = math.hypot(wrist_radius, wrist_height)
    if not abs(_UPPER - _FORE) < reach < _UPPER + _FORE:
        raise ValueError(f"the pose ({x:.3f}, {y:.3f}, {z:.3f}) m is out of the arm's reach")
    direction = math.atan2(wrist_radius, wrist_height)
    at_shoulder = math.acos((_UPPER**2 + reach**2 - _FORE**2) / (2 * _UPPER * reach))
    at_wrist = math.acos((_FORE**2 + reach**2 - _UPPER**2) / (2 * _FORE * reach))
    shoulder = direction - at_shoulder - _UPPER_ANGLE
    forearm_pitch = direction + at_wrist + _FORE_ANGLE
    return (base, shoulder, 0.0, shoulder - forearm_pitch, 0.0, forearm_pitch, HAND_MOUNT + base - phi)


def wrist_turn(base: float, wrist: float) -> float:
    """Return phi (radians, unwrapped) of a vertical gripper from the angles of joints 1 and 7."""
    return HAND_MOUNT + base - wrist
