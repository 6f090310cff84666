"""What a policy is shown. Dimension key: H W image."""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Observation:
    """What is known before an action; a learned policy sees the image and the step alone.

    Attributes:
        image: uint8 [H, W, 3] RGB.
        step: 0 .. max_steps.
        gripper_pose: float32 [4], measured x, y, z (metres) and phi (radians, unwrapped).
    """

    image: np.ndarray
    step: int
    gripper_pose: np.ndarray
