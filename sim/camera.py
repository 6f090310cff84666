"""The fixed camera, on the symmetry plane y = 0 and opposite the robot, so that a mirrored picture is a valid picture.

The light lies in the same plane; TinyRenderer draws, so the pixels do not depend on a graphics card.
"""

import dataclasses

import numpy as np

from graspq.sim.bullet import bullet
from graspq.sim.world import World


@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole camera on the symmetry plane.

    Attributes:
        target: point in the centre of the picture, metres in the world.
        distance: from the target to the camera, metres.
        pitch: degrees below the horizon, negative looks down.
        field_of_view: degrees, vertical.
        light: direction towards the light; its y is 0.
        shadows: whether shadows are drawn; the gripper's shadow shows where it will land.
    """

    target: tuple[float, float, float] = (0.52, 0.0, 0.07)
    distance: float = 0.9
    pitch: float = -60.0
    field_of_view: float = 28.0
    light: tuple[float, float, float] = (0.35, 0.0, 1.0)
    shadows: bool = True

    def render(self, world: World, size: int) -> np.ndarray:
        """Return a picture, uint8 [size, size, 3] RGB; columns run along +y, rows towards the camera (+x)."""
        view = bullet.computeViewMatrixFromYawPitchRoll(self.target, self.distance, 90.0, self.pitch, 0.0, 2)
        projection = list(bullet.computeProjectionMatrixFOV(self.field_of_view, 1.0, 0.1, 3.0))
        # TinyRenderer samples a pixel at its corner, which shifts the picture by half a pixel and would break its
        # mirror symmetry: shift it back. Entry 8 multiplies the view's z, the negative of the clip space's w.
        projection[8] += 1.0 / size
        _, _, rgba, _, _ = bullet.getCameraImage(
            size,
            size,
            view,
            projection,
            lightDirection=self.light,
            lightColor=(1.0, 1.0, 1.0),
            lightDistance=2.0,
            lightAmbientCoeff=0.55,
            lightDiffuseCoeff=0.45,
            lightSpecularCoeff=0.0,
            shadow=int(self.shadows),
            renderer=bullet.ER_TINY_RENDERER,
            flags=bullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=world.client,
        )
        return np.ascontiguousarray(np.asarray(rgba, dtype=np.uint8).reshape(size, size, 4)[:, :, :3])
