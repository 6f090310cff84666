"""Convex polytopes and the exact mass properties of their union.

A union of k convex parts is integrated by inclusion and exclusion over the intersections of its parts, which are convex
polytopes themselves; so what overlaps counts once, without sampling.

Dimension key: V vertices, F triangles, H half-spaces (one a face plane), P parts.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy.optimize
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
    intersection is empty so are those of its supersets.

    Args:
        parts: convex, watertight, faces outward; metres.

    Returns:
        Mass properties for density 1, about the origin. Overlaps count once.

    Raises:
        UserError: so many parts lie inside each other that the sum would have more than 4,096 terms.
    """
    size = max(float(np.ptp(part.vertices, axis=0).max()) for part in parts)
    planes = [half_spaces(part) for part in parts]
    total = np.zeros(13)
    level: list[tuple[tuple[int, ...], trimesh.Trimesh]] = [((index,), part) for index, part in enumerate(parts)]
    terms, sign = 0, 1.0
    while level:
        terms += len(level)
        if terms > _MOST_INTERSECTIONS:
            raise UserError(f"{len(parts)} parts lie inside each other too often to integrate; merge some of them")
        for _, polytope in level:
            total += sign * _integrals(polytope)
        level = [
            ((*subset, index), common)
            for subset, polytope in level
            for index in range(subset[-1] + 1, len(parts))
            if (common := _intersection(polytope, parts[index], [planes[i] for i in (*subset, index)], size))
            is not None
        ]
        sign = -sign
    return MassProperties(float(total[0]), total[1:4], total[4:].reshape(3, 3))


def _integrals(mesh: trimesh.Trimesh) -> Array:
    """Return volume, first moments and inertia about the origin of one solid as 13 numbers."""
    # Integrated near the origin and moved back (Steiner): far from it the differences of large numbers lose digits.
    shift = mesh.vertices.mean(axis=0)
    properties = trimesh.triangles.mass_properties((mesh.vertices - shift)[mesh.faces])
    volume, c = float(properties["volume"]), np.asarray(properties["center_mass"]) + shift
    inertia = np.asarray(properties["inertia"]) + volume * (c @ c * np.eye(3) - np.outer(c, c))
    return np.concatenate([[volume], volume * c, inertia.ravel()])


def _intersection(
    polytope: trimesh.Trimesh, part: trimesh.Trimesh, planes: Sequence[Array], size: float
) -> trimesh.Trimesh | None:
    """Return the intersection of `polytope` and `part`, or None where it is empty or thin.

    `planes`: half-spaces [H, 4] of all parts that made `polytope`, and last those of `part`.
    """
    # Most pairs that do not meet are kept apart by a face of one of them (or by their boxes): no search is needed then.
    low, high = (function(part.vertices, axis=0) for function in (np.min, np.max))
    gap = np.minimum(high, polytope.vertices.max(axis=0)) - np.maximum(low, polytope.vertices.min(axis=0))
    if gap.min() < _THIN * size:
        return None
    stacked = np.vstack(planes)
    if _apart(planes[-1], polytope, size) or _apart(np.vstack(planes[:-1]), part, size):
        return None
    line = np.linspace(polytope.vertices.mean(axis=0), part.vertices.mean(axis=0), 9)
    inside = _deepest(stacked, np.concatenate([line, polytope.vertices, part.vertices]), 1e-3 * size)
    if inside is None:
        inside = _largest_ball(stacked, _THIN * size)
    if inside is None:
        return None
    corners = scipy.spatial.HalfspaceIntersection(stacked, inside).intersections
    try:
        return convex_hull(corners[np.isfinite(corners).all(axis=1)])
    except ValueError:
        return None


def _apart(planes: Array, other: trimesh.Trimesh, size: float) -> bool:
    """Return whether a face plane of one part has (all but a thin layer of) the other on its outer side."""
    outside = planes[:, :3] @ other.vertices.T + planes[:, 3:]
    return float(outside.min(axis=1).max()) > -_THIN * size


def _deepest(planes: Array, candidates: Array, least: float) -> Array | None:
    """Return the candidate [3] that lies deepest inside half-spaces [H, 4], None when that is less than `least`."""
    depths = -(candidates @ planes[:, :3].T + planes[:, 3]).max(axis=1)
    best = int(depths.argmax())
    point: Array = candidates[best]
    return point if depths[best] > least else None


def _largest_ball(planes: Array, least: float) -> Array | None:
    """Return the centre of the largest ball inside half-spaces [H, 4], None when its radius is less than `least`.

    The Chebyshev centre: maximise r subject to n·x + r ≤ −d for each plane.
    """
    result = scipy.optimize.linprog(
        [0.0, 0.0, 0.0, -1.0],
        A_ub=np.c_[planes[:, :3], np.ones(len(planes))],
        b_ub=-planes[:, 3],
        bounds=[(None, None)] * 4,
        method="highs-ds",
    )
    if not result.success or result.x[3] < least:
        return None
    point: Array = result.x[:3]
    return point


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
