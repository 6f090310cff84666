"""A picture of one object on a floor: the ray of a pixel meets a convex part or the floor, and from there the light.

Dimension key: S pixels of a square image, R rays, H face planes of a part. World frame: z up, floor at z = 0, metres.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.ndimage
import trimesh

from graspq.objects.geometry import Array, half_spaces, horizontal_axes

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
Indices = npt.NDArray[np.int64]

BACKGROUND = (246 / 255, 247 / 255, 249 / 255)
_SUPERSAMPLING = 2
_TURN = math.radians(28)
_ELEVATION = math.radians(32)
_RIGHT = np.array([1.0, 0.0, 0.0])
_TO_VIEWER = np.array([0.0, -math.cos(_ELEVATION), math.sin(_ELEVATION)])
_TO_LIGHT = np.array([-0.45, -0.55, 1.0]) / math.sqrt(0.45**2 + 0.55**2 + 1.0)
_AMBIENT, _DIFFUSE, _SKY = 0.42, 0.50, 0.10
_EDGE, _SHADOW = 0.72, 0.30


def standing(parts: Sequence[trimesh.Trimesh], up: Array) -> list[trimesh.Trimesh]:
    """Return the parts of an object that stands on the floor at the origin with `up` [3] upwards.

    The longest horizontal direction goes across the picture, turned a little so that two sides show.
    """
    axes = np.column_stack([horizontal_axes(up), up])
    flat = np.concatenate([part.vertices for part in parts]) @ axes[:, :2]
    angles = np.linspace(0, math.pi, 36, endpoint=False)
    spans = np.ptp(flat @ np.stack([np.cos(angles), np.sin(angles)]), axis=0)
    turn = _TURN - angles[int(spans.argmax())]
    c, s = math.cos(turn), math.sin(turn)
    axes[:, :2] = axes[:, :2] @ np.array([[c, s], [-s, c]])
    points = np.concatenate([part.vertices for part in parts]) @ axes
    low, high = points.min(axis=0), points.max(axis=0)
    foot = np.array([*((low + high) / 2)[:2], low[2]])
    return [trimesh.Trimesh(part.vertices @ axes - foot, part.faces, process=False) for part in parts]


def draw(parts: Sequence[trimesh.Trimesh], color: Sequence[float], size: int, width: float) -> Image:
    """Draw an object on the floor.

    Args:
        parts: convex, metres, standing on z = 0 near the origin.
        color: red, green, blue in [0, 1].
        size: S, pixels of the square picture.
        width: metres the picture covers from left to right.

    Returns:
        [S, S, 3] uint8.
    """
    fine, convex = size * _SUPERSAMPLING, [_Part.of(part) for part in parts]
    across = ((np.arange(fine) + 0.5) / fine - 0.5) * width
    middle = np.array([0.0, 0.0, max(part.vertices[:, 2].max() for part in parts) / 2])
    rows = np.cross(_TO_VIEWER, _RIGHT) * -across[:, None, None]
    starts = (middle + _RIGHT * across[:, None] + rows).reshape(-1, 3)
    distance, normal = _first_hits(convex, starts)
    edge = _edges(distance.reshape(fine, fine), normal.reshape(fine, fine, 3), width).ravel()
    on_floor = starts - _TO_VIEWER * (starts[:, 2:] / _TO_VIEWER[2])
    dark = _in_shadow(convex, on_floor).reshape(fine, fine).astype(np.float64)
    picture = np.array(BACKGROUND) * (1 - _SHADOW * scipy.ndimage.gaussian_filter(dark, fine / 90)).reshape(-1, 1)
    seen = np.isfinite(distance)
    facing = (normal[seen] @ _TO_LIGHT).clip(0, None)
    facing *= ~_in_shadow(convex, starts[seen] - _TO_VIEWER * distance[seen, None])
    light = (_AMBIENT + _DIFFUSE * facing + _SKY * normal[seen, 2]) * np.where(edge[seen], _EDGE, 1.0)
    picture[seen] = light[:, None] * np.asarray(color)[:3]
    blocks = picture.clip(0, 1).reshape(size, _SUPERSAMPLING, size, _SUPERSAMPLING, 3)
    small: Image = np.rint(blocks.mean(axis=(1, 3)) * 255).astype(np.uint8)
    return small


class _Part(NamedTuple):
    """A convex part: its face planes [H, 4], and a ball around it that tells which rays may meet it."""

    planes: Array
    centre: Array
    radius: float

    @classmethod
    def of(cls, part: trimesh.Trimesh) -> "_Part":
        points = np.asarray(part.vertices)
        centre = points.mean(axis=0)
        return cls(half_spaces(part), centre, float(np.linalg.norm(points - centre, axis=1).max()))

    def crossed(self, starts: Array, direction: Array) -> tuple[Indices, Array, Array, Array]:
        """Return which of the rays [R, 3] cross the part; where they enter, with that face's normal, and leave.

        A ray enters through the last of the planes that face it and leaves through the first of the others.
        """
        from_centre = starts - self.centre
        squared = np.einsum("rk,rk->r", from_centre, from_centre) - (from_centre @ direction) ** 2
        rays = np.flatnonzero(squared <= self.radius**2)
        slope = self.planes[:, :3] @ direction
        # A plane along the ray is met far before or behind it.
        slope[np.abs(slope) < 1e-9] = 1e-9
        meets = (self.planes[:, :3] @ starts[rays].T + self.planes[:, 3:]) / -slope[:, None]
        faces = np.flatnonzero(slope < 0)
        face = faces[meets[faces].argmax(axis=0)]
        enters, leaves = meets[face, np.arange(len(rays))], meets[slope > 0].min(axis=0)
        cross = enters < leaves
        return rays[cross], enters[cross], leaves[cross], self.planes[face[cross], :3]


def _first_hits(convex: Sequence[_Part], starts: Array) -> tuple[Array, Array]:
    """Return how far from the viewer each ray first meets a face (inf where none), and its normal [R, 3]."""
    distance, normal = np.full(len(starts), np.inf), np.zeros((len(starts), 3))
    for part in convex:
        rays, enters, _, normals = part.crossed(starts, -_TO_VIEWER)
        nearer = enters < distance[rays]
        distance[rays[nearer]], normal[rays[nearer]] = enters[nearer], normals[nearer]
    return distance, normal


def _in_shadow(convex: Sequence[_Part], points: Array) -> Mask:
    """Return which points [R, 3] the light does not reach."""
    dark = np.zeros(len(points), dtype=bool)
    for part in convex:
        rays, _, leaves, _ = part.crossed(points, _TO_LIGHT)
        # A point on a face is not in its own shadow.
        dark[rays] |= leaves > 1e-6
    return dark


def _edges(distance: Array, normal: Array, width: float) -> Mask:
    """Return where an edge is drawn [S, S]: the face's direction or the distance jumps to the next pixel."""
    edge = np.zeros(distance.shape, dtype=bool)
    filled = np.where(np.isfinite(distance), distance, 10 * width)
    for axis in (0, 1):
        turned = (normal * np.roll(normal, 1, axis)).sum(axis=-1) < 0.97
        edge |= turned | (np.abs(filled - np.roll(filled, 1, axis)) > width / 40)
    return edge
