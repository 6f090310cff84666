"""A small software renderer for contact sheets: orthographic, flat faces, one light with shadows, no dependencies.

Dimension key: S pixels of a square image, V vertices, F triangles. World frame: z up, floor at z = 0, metres.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy.ndimage
import trimesh

from graspq.objects.geometry import Array

Image = npt.NDArray[np.uint8]

_SUPERSAMPLING = 2
_ELEVATION = math.radians(32)
_TURN = math.radians(28)
_LIGHT = np.array([-0.45, -0.55, 1.0]) / math.sqrt(0.45**2 + 0.55**2 + 1.0)
_AMBIENT, _DIFFUSE, _SKY = 0.42, 0.50, 0.10
_LINE = 0.72
_SHADOW = 0.30
BACKGROUND = (246 / 255, 247 / 255, 249 / 255)


@dataclasses.dataclass(frozen=True)
class View:
    """An orthographic view: `axes` [3, 3] rows right, up, towards the viewer; `pixel` metres; `size` S pixels."""

    axes: Array
    pixel: float
    size: int

    def project(self, points: Array) -> Array:
        """Return columns, rows (pixels) and depth (metres, larger is nearer) of points [..., 3]."""
        x, y, depth = np.moveaxis(points @ self.axes.T, -1, 0)
        return np.stack([self.size / 2 + x / self.pixel, self.size / 2 - y / self.pixel, depth], axis=-1)

    def unproject(self, depth: Array) -> Array:
        """Return the world points [S, S, 3] seen at each pixel's `depth` [S, S]."""
        rows, columns = np.indices(depth.shape) + 0.5
        x, y = (columns - self.size / 2) * self.pixel, (self.size / 2 - rows) * self.pixel
        world: Array = np.stack([x, y, depth], axis=-1) @ self.axes
        return world


def looking_along(towards: Array, pixel: float, size: int) -> View:
    """Return the view from direction `towards` [3] with the world's z upwards in the picture."""
    right = np.cross([0.0, 0.0, 1.0], towards)
    right /= np.linalg.norm(right)
    return View(np.stack([right, np.cross(towards, right), towards]), pixel, size)


def standing(parts: Sequence[trimesh.Trimesh], up: Array) -> Array:
    """Return the triangles [F, 3, 3] of an object that stands on the floor with `up` [3] upwards.

    The longest horizontal direction goes across the picture, turned a little so that two sides show.
    """
    corners = np.concatenate([part.vertices[part.faces] for part in parts])
    helper = np.eye(3)[int(np.abs(up).argmin())]
    first = np.cross(up, helper)
    first /= np.linalg.norm(first)
    upright = corners @ np.stack([first, np.cross(up, first), up]).T
    flat = upright[..., :2].reshape(-1, 2)
    angles = np.linspace(0, math.pi, 36, endpoint=False)
    spans = np.ptp(flat @ np.stack([np.cos(angles), np.sin(angles)]), axis=0)
    turn = _TURN - angles[int(spans.argmax())]
    c, s = math.cos(turn), math.sin(turn)
    upright = upright @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T
    points = upright.reshape(-1, 3)
    low, high = points.min(axis=0), points.max(axis=0)
    centred: Array = upright - np.array([*((low + high) / 2)[:2], low[2]])
    return centred


def draw(triangles: Array, color: Sequence[float], size: int, width: float) -> Image:
    """Draw an object on the floor.

    Args:
        triangles: [F, 3, 3] metres, outward faces, standing on z = 0 near the origin.
        color: red, green, blue in [0, 1].
        size: S, pixels of the square picture.
        width: metres the picture covers from left to right.

    Returns:
        [S, S, 3] uint8.
    """
    fine = size * _SUPERSAMPLING
    view = looking_along(np.array([0.0, -math.cos(_ELEVATION), math.sin(_ELEVATION)]), width / fine, fine)
    middle = np.array([0.0, 0.0, float(triangles[..., 2].max()) / 2])
    moved = triangles - middle
    face, depth = rasterise(view.project(moved), fine)
    normals = np.cross(moved[:, 1] - moved[:, 0], moved[:, 2] - moved[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    picture = np.empty((fine, fine, 3))
    picture[:] = BACKGROUND
    picture *= (1 - _SHADOW * _floor_shadow(view, triangles, middle, fine))[..., None]
    seen = face >= 0
    normal = normals[face]
    facing = (normal @ _LIGHT).clip(0, None) * ~_in_shadow(view, moved, depth, seen)
    light = _AMBIENT + _DIFFUSE * facing + _SKY * normal[..., 2]
    light *= np.where(_lines(normal, depth, seen, width), _LINE, 1.0)
    picture[seen] = (light[..., None] * np.asarray(color)[:3])[seen]
    blocks = picture.clip(0, 1).reshape(size, _SUPERSAMPLING, size, _SUPERSAMPLING, 3)
    small: Image = np.rint(blocks.mean(axis=(1, 3)) * 255).astype(np.uint8)
    return small


def rasterise(projected: Array, size: int) -> tuple[npt.NDArray[np.int64], Array]:
    """Return for each pixel the nearest triangle (−1 for none) and its depth (−inf), both [S, S].

    `projected` [F, 3, 3]: column, row and depth of each corner.
    """
    face = np.full((size, size), -1, dtype=np.int64)
    nearest = np.full((size, size), -np.inf)
    for index, corners in enumerate(projected):
        low = np.floor(corners[:, :2].min(axis=0)).astype(int).clip(0, size)
        high = np.ceil(corners[:, :2].max(axis=0)).astype(int).clip(0, size)
        a, edges = corners[0], corners[1:] - corners[0]
        area = edges[0, 0] * edges[1, 1] - edges[0, 1] * edges[1, 0]
        if (high <= low).any() or abs(area) < 1e-9:
            continue
        x = np.arange(low[0], high[0]) + 0.5 - a[0]
        y = (np.arange(low[1], high[1]) + 0.5 - a[1])[:, None]
        u = (x * edges[1, 1] - y * edges[1, 0]) / area
        v = (y * edges[0, 0] - x * edges[0, 1]) / area
        depth = a[2] + u * edges[0, 2] + v * edges[1, 2]
        window = np.s_[low[1] : high[1], low[0] : high[0]]
        nearer = (u >= 0) & (v >= 0) & (u + v <= 1) & (depth > nearest[window])
        nearest[window][nearer] = depth[nearer]
        face[window][nearer] = index
    return face, nearest


def _floor_shadow(view: View, triangles: Array, middle: Array, size: int) -> Array:
    """Return how dark the floor is at each pixel, in [0, 1]: the object's shadow with soft edges."""
    cast = triangles - triangles[..., 2:] / _LIGHT[2] * _LIGHT
    mask = rasterise(view.project(cast - middle), size)[0] >= 0
    blurred: Array = scipy.ndimage.gaussian_filter(mask.astype(np.float64), size / 90)
    return blurred


def _in_shadow(view: View, moved: Array, depth: Array, seen: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return where another face of the object lies between the pixel and the light (a shadow map)."""
    light = looking_along(_LIGHT, view.pixel, view.size)
    nearest = rasterise(light.project(moved), view.size)[1]
    columns, rows, own = np.moveaxis(light.project(view.unproject(np.where(seen, depth, 0.0))), -1, 0)
    column, row = (values.astype(int).clip(0, view.size - 1) for values in (columns, rows))
    dark: npt.NDArray[np.bool_] = seen & (nearest[row, column] > own + 3 * view.pixel)
    return dark


def _lines(normal: Array, depth: Array, seen: npt.NDArray[np.bool_], width: float) -> npt.NDArray[np.bool_]:
    """Return where an edge is drawn: the face's direction or the depth jumps to the next pixel."""
    line = np.zeros(seen.shape, dtype=bool)
    filled = np.where(seen, depth, -1.0)
    for axis in (0, 1):
        turned = (normal * np.roll(normal, 1, axis)).sum(axis=-1) < 0.97
        jumped = np.abs(filled - np.roll(filled, 1, axis)) > width / 40
        line |= turned | jumped
    return line & seen
