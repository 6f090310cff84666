"""How likely an object comes to rest so that a parallel jaw can take it from above, as a number between 0 and 1.

Geometric: no forces, no neighbours. Dimension key: P surface points, Y turns of the gripper about the vertical.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import trimesh

from graspq.objects.geometry import Array, horizontal_axes
from graspq.objects.resting import resting_poses


@dataclasses.dataclass(frozen=True)
class Jaw:
    """What fits between and beside the fingers when they have come down; metres.

    `widest`: between the pads. `pads`: heights over the floor that they reach from and to; `least_height`: of what
    they hold. `half_width` of a pad along the jaw, `fingers`: where each open finger stands, from the grasp's centre.
    """

    widest: float = 0.070
    pads: tuple[float, float] = (0.013, 0.064)
    least_height: float = 0.024
    half_width: float = 0.011
    fingers: tuple[float, float] = (0.0385, 0.0575)
    finger_half_width: float = 0.0135


JAW = Jaw()
_TURNS = np.linspace(0, math.pi, 12, endpoint=False)
# Along the pads, from the centre of mass; the middle first, since most objects are taken there.
_OFFSETS = (0.0, 0.012, -0.012, 0.024, -0.024)
_SPACING = 0.008


def graspable_share(parts: Sequence[trimesh.Trimesh]) -> float:
    """Return the probability that an object rests so that the jaw can take it near its centre of mass, the origin."""
    corners = np.concatenate([part.vertices for part in parts])
    surface = np.concatenate(
        [trimesh.remesh.subdivide_to_size(part.vertices, part.faces, _SPACING, max_iter=20)[0] for part in parts]
    )
    poses = resting_poses(corners, np.zeros(3), least=0.03)
    fits = [_can_take(surface, float((corners @ pose.up).min()), pose.up) for pose in poses]
    return sum(pose.probability for pose, fit in zip(poses, fits, strict=True) if fit)


def _can_take(surface: Array, floor: float, up: Array) -> bool:
    """Return whether some turn and offset of the jaw holds the body between its pads, with room for the fingers."""
    height = surface @ up - floor
    flat = (surface @ horizontal_axes(up))[height > 0.008]
    height = height[height > 0.008]
    in_reach = (height > JAW.pads[0]) & (height < JAW.pads[1])
    turns = np.stack([np.cos(_TURNS), np.sin(_TURNS)])
    # [Y, P]: along the pads, and along the closing direction.
    along, across = (flat @ turns).T, (flat @ np.stack([-turns[1], turns[0]])).T
    for offset in _OFFSETS:
        beside = np.abs(along - offset)
        held = in_reach & (beside < JAW.half_width)
        # Far apart where nothing is held.
        low, high = np.where(held, across, 1.0).min(axis=1), np.where(held, across, -1.0).max(axis=1)
        fits = (np.abs(high - low) < JAW.widest) & (np.where(held, height, 0.0).max(axis=1) > JAW.least_height)
        middle = ((low + high) / 2)[fits, None]
        from_middle = np.abs(across[fits] - middle)
        hit = (beside[fits] < JAW.finger_half_width) & (from_middle > JAW.fingers[0]) & (from_middle < JAW.fingers[1])
        if ((np.abs(middle[:, 0]) < 0.04) & ~hit.any(axis=1)).any():
            return True
    return False
