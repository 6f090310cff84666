"""Resting poses of a rigid body on a floor: how likely each is, and which way is then up.

Quasi-static: it falls in a random orientation, lands on the face below its centre of mass and tips over edges until
that centre lies above the face it stands on. Dimension key: V points, F triangles of the convex hull.
"""

import dataclasses

import numpy as np
import numpy.typing as npt
import scipy.spatial

from graspq.objects.geometry import Array


@dataclasses.dataclass(frozen=True)
class RestingPose:
    """One stable pose: `probability`; `up` [3], the unit vector that then points up."""

    probability: float
    up: Array


def resting_poses(points: Array, centre: Array, least: float = 0.01) -> tuple[RestingPose, ...]:
    """Return the stable poses of the hull of `points`, the likeliest first.

    Args:
        points: [V, 3] metres.
        centre: [3] centre of mass, inside the hull.
        least: poses less likely than this are left out.

    Source: Goldberg et al. 1999, Part pose statistics: estimators and experiments (the quasi-static estimator).
    """
    hull = scipy.spatial.ConvexHull(points)
    _, first, face_of = np.unique(np.round(hull.equations, 7), axis=0, return_index=True, return_inverse=True)
    planes = hull.equations[first]
    face_of = face_of.ravel().astype(np.int64)
    corners = points[hull.simplices] - centre
    weight: Array = np.bincount(face_of, _solid_angles(corners), minlength=len(planes)).astype(np.float64)
    rolls_to = _rolls_to(hull, corners, face_of, len(planes))
    distance = -(planes[:, :3] @ centre + planes[:, 3])
    # Tipping lowers the centre of mass, so going from the highest face to the lowest passes every weight on once.
    for face in np.argsort(-distance, kind="stable"):
        if rolls_to[face] >= 0 and distance[rolls_to[face]] < distance[face]:
            weight[rolls_to[face]] += weight[face]
            weight[face] = 0.0
    weight /= weight.sum()
    poses = []
    for face in np.argsort(-weight, kind="stable"):
        if weight[face] < max(least, 1e-12):
            break
        poses.append(RestingPose(float(weight[face]), -planes[face, :3]))
    return tuple(poses)


def _solid_angles(corners: Array) -> Array:
    """Return the solid angle of each triangle [F, 3, 3] seen from the origin (Van Oosterom and Strackee 1983)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    volume = np.abs((a * np.cross(b, c)).sum(axis=1))
    denominator = la * lb * lc + (a * b).sum(axis=1) * lc + (b * c).sum(axis=1) * la + (c * a).sum(axis=1) * lb
    angles: Array = 2 * np.arctan2(volume, denominator)
    return angles


def _rolls_to(hull: scipy.spatial.ConvexHull, corners: Array, face_of: npt.NDArray[np.int64], faces: int) -> list[int]:
    """Return for each face the neighbour onto which the body tips when it stands there, or −1 where it stands."""
    worst = [0.0] * faces
    target = [-1] * faces
    normals = hull.equations[:, :3]
    # The foot of the centre of mass (the origin) on each triangle's plane.
    foot = normals * (normals * corners[:, 0]).sum(axis=1, keepdims=True)
    for opposite in range(3):
        start, end = corners[:, (opposite + 1) % 3], corners[:, (opposite + 2) % 3]
        outward = np.cross(end - start, normals)
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        outward *= np.sign((outward * (start - corners[:, opposite])).sum(axis=1, keepdims=True))
        outside = (outward * (foot - start)).sum(axis=1)
        neighbour = face_of[hull.neighbors[:, opposite]]
        for triangle in np.flatnonzero((neighbour != face_of) & (outside > 0)):
            face = int(face_of[triangle])
            if outside[triangle] > worst[face]:
                worst[face], target[face] = float(outside[triangle]), int(neighbour[triangle])
    return target
