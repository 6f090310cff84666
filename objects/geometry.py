"""Convex parts: their hulls and face planes, the exact mass properties of their union, directions.

Dimension key: V vertices, H half-spaces (one a face plane).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import manifold3d
import numpy as np
import numpy.typing as npt
import scipy.spatial
import trimesh

Array = npt.NDArray[np.float64]


def convex_hull(points: Array) -> trimesh.Trimesh:
    """Return the convex hull of `points` [V, 3] as a watertight mesh with outward faces and no unused vertices.

    Raises:
        ValueError: the points do not span a volume.
    """
    try:
        hull = scipy.spatial.ConvexHull(points)
    except scipy.spatial.QhullError:
        raise ValueError(f"{len(points)} points span no volume") from None
    faces = hull.simplices.copy()
    corners = points[faces]
    inward = np.linalg.det(corners - points.mean(axis=0)) < 0
    faces[inward] = faces[inward][:, ::-1]
    # Order of vertices and faces: a function of the geometry alone, whatever order Qhull visited them in.
    used = np.unique(faces)
    faces = np.searchsorted(used, faces)
    turn = faces.argmin(axis=1)[:, None]
    faces = np.take_along_axis(faces, (turn + np.arange(3)) % 3, axis=1)
    faces = faces[np.lexsort(faces.T[::-1])]
    return trimesh.Trimesh(points[used], faces, process=False, validate=False)


def half_spaces(part: trimesh.Trimesh) -> Array:
    """Return the face planes of a convex part: `[H, 4]` rows (n, d) with n outward and unit, n·x + d ≤ 0 inside."""
    equations: Array = np.unique(np.round(scipy.spatial.ConvexHull(part.vertices).equations, 12), axis=0)
    return equations


class MassProperties(NamedTuple):
    """Of a solid of density 1: `volume` m³, `centre` [3] of mass in metres, `inertia` [3, 3] about that centre, m⁵."""

    volume: float
    centre: Array
    inertia: Array


def union_mass_properties(parts: Sequence[trimesh.Trimesh]) -> MassProperties:
    """Integrate over the union of parts: overlaps count once.

    Args:
        parts: convex, watertight, faces outward; metres.

    Returns:
        Mass properties for density 1.
    """
    solids = [
        manifold3d.Manifold(manifold3d.Mesh64(np.asarray(part.vertices), np.asarray(part.faces, dtype=np.uint64)))
        for part in parts
    ]
    mesh = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add).to_mesh64()
    corners = mesh.vert_properties[:, :3][mesh.tri_verts]
    # Integrated near the origin: far from it the differences of large numbers lose digits.
    shift = corners.mean(axis=(0, 1))
    properties = trimesh.triangles.mass_properties(corners - shift)
    return MassProperties(
        float(properties["volume"]), np.asarray(properties["center_mass"]) + shift, np.asarray(properties["inertia"])
    )


def horizontal_axes(up: Array) -> Array:
    """Return two unit vectors, the columns of [3, 2], that make a right-handed frame with `up` [3] as its third."""
    helper = np.eye(3)[int(np.abs(up).argmin())]
    first = np.cross(up, helper)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first)], axis=1)


def principal_axes(inertia: Array) -> tuple[Array, Array]:
    """Return the principal moments [3] and axes [3, 3] (columns, right-handed) of a symmetric tensor [3, 3].

    Jacobi's method: each axis stays nearest to the one that it was built along. Where moments coincide (a cube, a
    cylinder) all stay as they were, where a library's eigenvectors would be arbitrary.
    """
    scale = float(np.abs(inertia).max())
    moments, axes = np.round(inertia / scale, 7), np.eye(3)
    for p, q in 20 * ((0, 1), (0, 2), (1, 2)):
        # A coupling below the rounding says nothing; between equal moments it would turn the axes at random.
        if abs(moments[p, q]) < 2e-7:
            continue
        # The smaller of the two rotations that make the coupling zero, by its tangent.
        ratio = (moments[q, q] - moments[p, p]) / (2 * moments[p, q])
        tangent = math.copysign(1.0, ratio) / (abs(ratio) + math.sqrt(ratio * ratio + 1))
        turn = np.eye(3)
        turn[p, p] = turn[q, q] = 1 / math.sqrt(tangent * tangent + 1)
        turn[p, q] = tangent * turn[p, p]
        turn[q, p] = -turn[p, q]
        moments, axes = turn.T @ moments @ turn, axes @ turn
    return moments.diagonal() * scale, axes
