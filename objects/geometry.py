"""Convex parts: their hulls and face planes, the exact mass properties of their union, directions.

Dimension key: V vertices, H half-spaces (one a face plane).
"""

import dataclasses
import math
from collections.abc import Sequence

import manifold3d
import numpy as np
import numpy.typing as npt
import scipy.spatial
import trimesh

from graspq.common.errors import UserError

Array = npt.NDArray[np.float64]

# Intersections thinner than this fraction of the object's size are touching faces, without volume to speak of.
_THIN = 1e-5
_MOST_INTERSECTIONS = 4096


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


@dataclasses.dataclass(frozen=True)
class MassProperties:
    """Integrals over a solid of density 1, all about the origin.

    `volume` m³, `first` [3] m⁴ (volume times centre), `inertia` [3, 3] m⁵.
    """

    volume: float
    first: Array
    inertia: Array

    @property
    def centre(self) -> Array:
        """Centre of mass [3], metres."""
        return self.first / self.volume

    def inertia_about_centre(self) -> Array:
        """Inertia tensor [3, 3] about the centre of mass (Steiner's theorem), m⁵."""
        c = self.centre
        shifted: Array = self.inertia - self.volume * (c @ c * np.eye(3) - np.outer(c, c))
        return shifted


def union_mass_properties(parts: Sequence[trimesh.Trimesh]) -> MassProperties:
    """Integrate over the union of convex parts, exactly.

    ∫_{∪ Pᵢ} f = Σ_{S ≠ ∅} (−1)^{|S|+1} ∫_{∩_{i∈S} Pᵢ} f; subsets S are grown one part at a time, and where an
    intersection is empty or as thin as touching faces, so are those of its supersets.

    Args:
        parts: convex, watertight, faces outward; metres.

    Returns:
        Mass properties for density 1, about the origin. Overlaps count once.

    Raises:
        UserError: so many parts lie inside each other that the sum would have more than 4,096 terms.
    """
    size = max(float(np.ptp(part.vertices, axis=0).max()) for part in parts)
    solids = [_solid(part) for part in parts]
    total = np.zeros(13)
    level = list(enumerate(solids))
    terms, sign = 0, 1.0
    while level:
        terms += len(level)
        if terms > _MOST_INTERSECTIONS:
            raise UserError(f"{len(parts)} parts lie inside each other too often to integrate; merge some of them")
        total += sign * sum(_integrals(common) for _, common in level)
        level = [
            (other, both)
            for last, common in level
            for other in range(last + 1, len(parts))
            # A slab's volume over its surface is half its thickness.
            if (both := common ^ solids[other]).volume() > _THIN * size * both.surface_area()
        ]
        sign = -sign
    return MassProperties(float(total[0]), total[1:4], total[4:].reshape(3, 3))


def _solid(part: trimesh.Trimesh) -> manifold3d.Manifold:
    return manifold3d.Manifold(manifold3d.Mesh64(np.asarray(part.vertices), np.asarray(part.faces, dtype=np.uint64)))


def _integrals(solid: manifold3d.Manifold) -> Array:
    """Return volume, first moments and inertia about the origin of one solid as 13 numbers."""
    mesh = solid.to_mesh64()
    corners = mesh.vert_properties[:, :3][mesh.tri_verts]
    # Integrated near the origin and moved back (Steiner): far from it the differences of large numbers lose digits.
    shift = corners.mean(axis=(0, 1))
    properties = trimesh.triangles.mass_properties(corners - shift)
    volume, c = float(properties["volume"]), np.asarray(properties["center_mass"]) + shift
    inertia = np.asarray(properties["inertia"]) + volume * (c @ c * np.eye(3) - np.outer(c, c))
    return np.concatenate([[volume], volume * c, inertia.ravel()])


def horizontal_axes(up: Array) -> Array:
    """Return two unit vectors, the columns of [3, 2], that make a right-handed frame with `up` [3] as its third."""
    helper = np.eye(3)[int(np.abs(up).argmin())]
    first = np.cross(up, helper)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first)], axis=1)


def principal_axes(inertia: Array) -> tuple[Array, Array]:
    """Return the principal moments [3] and axes [3, 3] (columns, right-handed) of a symmetric tensor.

    Jacobi's rotations, in plain floats: they give the same bits on every machine, and where two moments coincide (a
    cube, a cylinder) they leave the axes as they were built, where a library's eigenvectors would be arbitrary.
    """
    scale = float(np.abs(inertia).max())
    a = [[round(float(inertia[i, j]) / scale, 7) for j in range(3)] for i in range(3)]
    axes = [[float(i == j) for j in range(3)] for i in range(3)]
    for _ in range(20):
        for p, q in ((0, 1), (0, 2), (1, 2)):
            _rotate(a, axes, p, q)
    moments = np.array([a[i][i] for i in range(3)]) * scale
    # Each axis stays nearest to the axis it was built along; a proper rotation needs no change of sign.
    return moments, np.array(axes)


def _rotate(a: list[list[float]], axes: list[list[float]], p: int, q: int) -> None:
    """Zero the entry (p, q) of the symmetric `a` by the smaller of the two rotations, in place."""
    # A coupling below the rounding of the entries says nothing; between equal moments it would turn the axes at random.
    if abs(a[p][q]) < 2e-7:
        return
    theta = (a[q][q] - a[p][p]) / (2 * a[p][q])
    t = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(theta * theta + 1))
    c = 1 / math.sqrt(t * t + 1)
    s = t * c
    for row in (*axes, *a):
        row[p], row[q] = c * row[p] - s * row[q], s * row[p] + c * row[q]
    for k in range(3):
        a[p][k], a[q][k] = c * a[p][k] - s * a[q][k], s * a[p][k] + c * a[q][k]
