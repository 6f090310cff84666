"""What a policy is shown. Dimension key: H W image."""

import dataclasses

import numpy as np

STILL = -1  # in a mask: the bin and its table
ARM = -2  # in a mask: the robot


@dataclasses.dataclass(frozen=True)
class Observation:
    """What is known before an action; a learned policy sees the image and the step alone.

    Attributes:
        image: uint8 [H, W, 3] RGB.
        step: 0 .. max_steps.
        gripper_pose: float32 [4], measured x, y, z (metres) and phi (radians, unwrapped).
        depth: float32 [H, W], from the camera along its axis to what the middle of a pixel shows, metres; None unless
            the simulation was asked for it.
        mask: int32 [H, W], what that is: an object by its place in the bin (0 .. K - 1), `STILL` or `ARM`; or None.
    """

    image: np.ndarray
    step: int
    gripper_pose: np.ndarray
    depth: np.ndarray | None = None
    mask: np.ndarray | None = None
