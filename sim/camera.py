"""The fixed camera, on the symmetry plane y = 0 and opposite the robot, so that a mirrored picture is a valid picture.

The light lies in the same plane.
"""

import dataclasses
import math

import numpy as np

_SHADOW_BIAS = 0.002  # metres that something must be nearer to the light, or a face would shade itself


@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole camera and a far light, both on the symmetry plane.

    Attributes:
        eye: where the camera is, metres in the world; its y is 0.
        target: point in the centre of the picture, metres in the world; its y is 0.
        half_view: half of the height and width that the picture shows of a plane at a distance of 1 m, metres.
        nearest: faces nearer than this along the camera's axis are not drawn, metres.
        light: direction towards the light; its y is 0.
        ambient: light that falls everywhere; a colour of 1 under a light of 1 is white.
        diffuse: light that falls on a face that is turned to the light.
        shaded: the share of `diffuse` that a shadow leaves; the gripper's shadow shows where it will land.
        shadow_half: half width of the square of the floor, around `target`, on which shadows fall, metres.
    """

    eye: tuple[float, float, float] = (0.97, 0.0, 0.8494)
    target: tuple[float, float, float] = (0.52, 0.0, 0.07)
    half_view: float = 0.24933
    nearest: float = 0.1
    light: tuple[float, float, float] = (0.35, 0.0, 1.0)
    ambient: float = 0.55
    diffuse: float = 0.45
    shaded: float = 0.5
    shadow_half: float = 0.33

    def view(self) -> np.ndarray:
        """Return what the rasteriser takes, float64 [11]; products and roots alone, which all machines agree on."""
        fx, fz = _unit(self.target[0] - self.eye[0], self.target[2] - self.eye[2])
        lx, lz = _unit(self.light[0], self.light[2])
        centre = self.target[0] * lz - self.target[2] * lx
        return np.array(
            [
                *(self.eye[0], self.eye[2], fx, fz, self.half_view, self.nearest),
                *(lx, lz, centre, self.shadow_half, _SHADOW_BIAS),
            ]
        )


def _unit(x: float, z: float) -> tuple[float, float]:
    length = math.sqrt(x * x + z * z)
    return x / length, z / length
