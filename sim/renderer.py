"""Pictures of a scene from the fixed camera: what never moves is drawn once, the rest on top of it.

Dimension key: P moving parts, V corners, F faces, H W image (H = W), S samples across it.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from graspq.sim import rasteriser
from graspq.sim.camera import Camera
from graspq.sim.observation import STILL

_AT_ORIGIN = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
_NOBODY = np.zeros((0, 0), np.int32)


@dataclasses.dataclass(frozen=True)
class Part:
    """A rigid mesh of one colour.

    Attributes:
        vertices: float [V, 3], metres, in the frame whose pose is given with each picture.
        faces: int [F, 3], triangles, outward by the right-hand rule.
        color: red, green, blue (and more, which is not read) in [0, 1].
        label: what a mask says of it.
    """

    vertices: np.ndarray
    faces: np.ndarray
    color: Sequence[float]
    label: int = STILL


def box(half_extents: Sequence[float], position: Sequence[float], color: Sequence[float]) -> Part:
    """Return a box by its half extents and its centre, metres."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6)]
    faces += [(0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
    return Part(signs * half_extents + position, np.array(faces), color)


class _Geometry:
    """Parts as the rasteriser takes them."""

    def __init__(self, parts: Sequence[Part]) -> None:
        corners = [np.asarray(part.vertices, dtype=np.float64).reshape(-1, 3) for part in parts]
        faces = [np.asarray(part.faces, dtype=np.int32).reshape(-1, 3) for part in parts]
        for vertices, triangles in zip(corners, faces, strict=True):
            if triangles.size and not 0 <= triangles.min() <= triangles.max() < len(vertices):
                raise ValueError(
                    f"a part's faces name corners {triangles.min()} .. {triangles.max()} of {len(vertices)}"
                )
        self.corner_starts = np.cumsum([0, *map(len, corners)], dtype=np.int32)
        self.face_starts = np.cumsum([0, *map(len, faces)], dtype=np.int32)
        self.vertices = np.concatenate([np.zeros((0, 3)), *corners])
        shifted = [triangles + start for triangles, start in zip(faces, self.corner_starts[:-1], strict=True)]
        self.faces = np.concatenate([np.zeros((0, 3), np.int32), *shifted]).astype(np.int32)
        a, b, c = (self.vertices[self.faces[:, index]] for index in range(3))
        normals = np.cross(b - a, c - a)
        lengths = np.sqrt(normals[:, 0] ** 2 + normals[:, 1] ** 2 + normals[:, 2] ** 2)[:, None]
        self.normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
        self.base = np.array([part.color[:3] for part in parts], dtype=np.float64).reshape(-1, 3).clip(0, 1)
        self.labels = np.repeat([part.label for part in parts], [len(triangles) for triangles in faces])
        self.seen, self.lit = np.empty_like(self.vertices), np.empty_like(self.vertices)


class _Canvas:
    """The still scene at one resolution, and room to draw on a copy of it."""

    def __init__(self, samples: int, texels: int) -> None:
        self.still_depth, self.depth = np.zeros((2, samples, samples), np.float32)
        self.still_owner, self.owner = np.zeros((2, samples, samples), np.int32)
        self.still_shadows, self.shadows = np.full((2, texels, texels), -np.inf, np.float32)


class Renderer:
    """Draws a scene of still and moving parts."""

    def __init__(self, camera: Camera, still: Sequence[Part]) -> None:
        """Keep what never moves; its parts stand in the world's frame.

        Raises:
            ValueError: a face names a corner that its part does not have.
        """
        self.camera = camera
        self._view = camera.view()
        self._light = np.array([camera.ambient, camera.diffuse, camera.shaded])
        self._still = _Geometry(still)
        self._still_poses = np.tile(_AT_ORIGIN, (len(still), 1))
        self._first = 1 + len(self._still.faces)  # number 0 is where nothing is
        self._canvases: dict[tuple[int, int], _Canvas] = {}
        self.hold(())

    def hold(self, moving: Sequence[Part]) -> None:
        """Keep what moves, in the place of what was held before.

        Raises:
            ValueError: a face names a corner that its part does not have.
        """
        self._moving = _Geometry(moving)
        self._colours = np.zeros((self._first + len(self._moving.faces), 2), np.int64)
        self._colour(self._still, self._still_poses, self._colours[1 : self._first])
        self._labels = np.concatenate([[STILL], self._still.labels, self._moving.labels]).astype(np.int32)

    def image(self, poses: np.ndarray, size: int) -> np.ndarray:
        """Return a picture, uint8 [size, size, 3] RGB; columns run along +y, rows towards the camera.

        Args:
            poses: float [P, 7], position (metres) and quaternion (xyzw) of each moving part.
            size: H.

        Raises:
            ValueError: `poses` has another shape.
        """
        poses = self._checked(poses)
        samples, texels = 2 * size, 2 * (7 * size // 4)
        canvas, moving = self._drawn(poses, samples, texels), self._moving
        canvas.shadows[:] = canvas.still_shadows
        rasteriser.fill(moving.lit, moving.faces, 0, -1, canvas.shadows, _NOBODY)
        self._colour(moving, poses, self._colours[self._first :])
        image = np.empty((size, size, 3), np.uint8)
        rasteriser.shade(canvas.depth, canvas.owner, canvas.shadows, self._colours, self._view, image)
        return image

    def depth_and_mask(self, poses: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
        """Return what lies behind the middle of each pixel.

        Args:
            poses: float [P, 7], position (metres) and quaternion (xyzw) of each moving part.
            size: H.

        Returns:
            float32 [size, size], the distance along the camera's axis in metres, inf where nothing is; and int32
            [size, size], the label of the part that is seen.

        Raises:
            ValueError: `poses` has another shape.
        """
        canvas = self._drawn(self._checked(poses), size, 0)
        with np.errstate(divide="ignore"):
            return 1 / canvas.depth, self._labels[canvas.owner]

    def _checked(self, poses: np.ndarray) -> np.ndarray:
        poses = np.ascontiguousarray(poses, dtype=np.float64)
        if poses.shape != (len(self._moving.base), 7):
            raise ValueError(f"expected poses of the shape [{len(self._moving.base)}, 7], got {list(poses.shape)}")
        return poses

    def _drawn(self, poses: np.ndarray, samples: int, texels: int) -> _Canvas:
        """Return a canvas with the scene as the camera sees it."""
        canvas, moving = self._canvas(samples, texels), self._moving
        self._project(moving, poses, samples, texels)
        canvas.depth[:], canvas.owner[:] = canvas.still_depth, canvas.still_owner
        rasteriser.fill(moving.seen, moving.faces, self._first, 1, canvas.depth, canvas.owner)
        return canvas

    def _canvas(self, samples: int, texels: int) -> _Canvas:
        if (samples, texels) not in self._canvases:
            canvas, still = _Canvas(samples, texels), self._still
            self._project(still, self._still_poses, samples, texels)
            rasteriser.fill(still.seen, still.faces, 1, 1, canvas.still_depth, canvas.still_owner)
            rasteriser.fill(still.lit, still.faces, 0, -1, canvas.still_shadows, _NOBODY)
            self._canvases[samples, texels] = canvas
        return self._canvases[samples, texels]

    def _project(self, geometry: _Geometry, poses: np.ndarray, samples: int, texels: int) -> None:
        corners = geometry.corner_starts, geometry.vertices
        rasteriser.project(poses, *corners, self._view, samples, texels, geometry.seen, geometry.lit)

    def _colour(self, geometry: _Geometry, poses: np.ndarray, colours: np.ndarray) -> None:
        faces = geometry.face_starts, geometry.normals
        rasteriser.colour(poses, *faces, geometry.base, self._view, self._light, colours)
