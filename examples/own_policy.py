"""A policy of your own: look for the blob of colour that is easiest to span, go over it, turn, go down.

cd examples && grasp-eval --policy own_policy:GoesForColour --policy random --episodes 200
"""

import numpy as np
from scipy import ndimage

from graspq.sim.observation import Observation

LIMITS = np.array([0.06, 0.06, 0.06, 0.4])  # of an action: metres and radians
COLOURED = 60  # the bin and the arm are grey
METRES_PER_COLUMN = 0.1 / 13.8
ROWS, XS = (26.8, 38.5, 51.6), (0.45, 0.55, 0.65)  # rows of the picture, and x of the floor there


class GoesForColour:
    """`grasp-eval` makes one in each worker. All that a policy must have is `act`."""

    def act(self, observation: Observation, rng: np.random.Generator) -> np.ndarray:
        """Return (dx, dy, dz, dphi), each in [-1, 1] and in units of the limits."""
        if observation.step == 0:
            self.goal = self.plan(observation.image, rng)
        way = np.zeros(4)
        way[[0, 1, 3]] = self.goal - observation.gripper_pose[[0, 1, 3]]
        action = way / LIMITS
        if np.abs(action).max() < 0.5:
            action[2] = -1  # over the goal: down
        clipped: np.ndarray = np.clip(action, -1, 1)
        return clipped

    def plan(self, image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return where to go: x, y and phi of the blob that is narrowest across."""
        pixels = image.astype(int)
        blobs, count = ndimage.label(pixels.max(axis=-1) - pixels.min(axis=-1) > COLOURED)
        candidates = []
        for number in range(1, count + 1):
            rows, columns = np.nonzero(blobs == number)
            if len(rows) < 12:
                continue
            x = np.polyval(np.polyfit(ROWS, XS, 2), rows)
            y = (columns - (image.shape[1] - 1) / 2) * METRES_PER_COLUMN
            spread, axes = np.linalg.eigh(np.cov(np.stack([x, y])))
            across_x, across_y = axes[:, 0]  # the fingers close along (-sin phi, cos phi)
            phi = np.arctan(-across_x / across_y) if across_y != 0 else np.pi / 2
            candidates.append((spread[0], np.array([x.mean(), y.mean(), phi])))
        if not candidates:
            return np.array([0.55, 0, 0]) + rng.uniform(-0.1, 0.1, size=3)
        return min(candidates, key=lambda candidate: candidate[0])[1]
