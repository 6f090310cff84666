"""Whether the gripper meets anything on its way: its boxes against the boxes round the obstacles, on the safe side.

Where it does not, the arm need not be simulated. Dimension key: S poses on the way, G boxes of the gripper,
O obstacles.
"""

import math
from collections.abc import Sequence

import numpy as np

_SPACING = 0.003  # metres between neighbouring poses on the way, at most, for each point of the gripper
_MARGIN = 0.002  # metres that a motion must stay away from everything; motors follow their set-points to less


class Boxes:
    """Axis-aligned boxes as float64 [N, 3] centres and half extents, metres."""

    def __init__(self, bounds: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
        """Take pairs of the least and the greatest corner, each [3], metres."""
        low, high = (np.array([pair[side] for pair in bounds], dtype=float).reshape(-1, 3) for side in (0, 1))
        self.centers, self.halves = (low + high) / 2, (high - low) / 2


def is_clear(gripper: Boxes, start: Sequence[float], goal: Sequence[float], obstacles: Boxes) -> bool:
    """Return whether the gripper stays clear of the obstacles from one pose to another.

    Args:
        gripper: the boxes of its parts at the pose (0, 0, 0, 0).
        start: (x, y, z, phi), metres and radians; the way to `goal` is straight, the turn even.
        goal: (x, y, z, phi).
        obstacles: in the world.
    """
    bottom = float((gripper.centers[:, 2] - gripper.halves[:, 2]).min()) + min(start[2], goal[2])
    if bottom > float((obstacles.centers[:, 2] + obstacles.halves[:, 2]).max(initial=-1.0)) + _MARGIN:
        return True
    reach = float((np.abs(gripper.centers[:, :2]) + gripper.halves[:, :2]).max()) * math.sqrt(2.0)
    length = math.dist(start[:3], goal[:3]) + reach * abs(goal[3] - start[3])
    count = max(1, math.ceil(length / _SPACING))
    poses = [
        [here + (there - here) * index / count for here, there in zip(start, goal, strict=True)]
        for index in range(count + 1)
    ]
    return not _meet(gripper, poses, obstacles, _MARGIN + length / count / 2)


def _meet(gripper: Boxes, poses: Sequence[Sequence[float]], obstacles: Boxes, margin: float) -> bool:
    """Return whether a part, a box turned about the vertical, comes within the margin of an obstacle at any pose."""
    place = np.array([pose[:3] for pose in poses])[:, None, None]
    cos, sin = (np.array([f(pose[3]) for pose in poses])[:, None, None] for f in (math.cos, math.sin))
    along, across, up = (gripper.centers[:, axis, None] for axis in range(3))
    half_along, half_across, half_up = (gripper.halves[:, axis, None] for axis in range(3))
    half_x, half_y, half_z = (obstacles.halves[:, axis] for axis in range(3))
    x = place[..., 0] + along * cos - across * sin - obstacles.centers[:, 0]  # [S, G, O]
    y = place[..., 1] + along * sin + across * cos - obstacles.centers[:, 1]
    z = place[..., 2] + up - obstacles.centers[:, 2]
    a, b = np.abs(cos), np.abs(sin)
    # Two boxes are apart where they are along an axis of one of them.
    near = np.abs(z) < half_up + half_z + margin
    near = near & (np.abs(x) < a * half_along + b * half_across + half_x + margin)
    near &= np.abs(y) < b * half_along + a * half_across + half_y + margin
    near &= np.abs(x * cos + y * sin) < half_along + a * half_x + b * half_y + margin
    near &= np.abs(y * cos - x * sin) < half_across + b * half_x + a * half_y + margin
    return bool(near.any())
