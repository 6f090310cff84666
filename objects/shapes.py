"""Seeded families of shapes: each draws a list of convex parts, about one unit large.

An object is the union of one to four convex parts; a ring or a bracket counts its pieces and may have up to eight. The
maker (`procedural.py`) scales the union to metres, so only proportions are drawn here.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from graspq.objects.geometry import Array, convex_hull

Parts: TypeAlias = list[trimesh.Trimesh]
Generator: TypeAlias = np.random.Generator

# Parts are rounded to this before their hull is taken: a last-bit difference of sin or cos between machines cannot
# change their triangles.
_DECIMALS = 6
CIRCLE_SIDES = 12
MOST_PARTS = 8


@dataclasses.dataclass(frozen=True)
class Shape:
    """Convex parts in one frame (no unit yet), and the families they came from, the main one first."""

    parts: tuple[trimesh.Trimesh, ...]
    families: tuple[str, ...]


def _hull(points: Array | list[list[float]]) -> trimesh.Trimesh:
    return convex_hull(np.round(np.asarray(points, dtype=np.float64), _DECIMALS).astype(np.float64) + 0.0)


def _polygon(sides: int, radius_x: float, radius_y: float, turn: float = 0.0) -> list[tuple[float, float]]:
    angles = [turn + 2 * math.pi * side / sides for side in range(sides)]
    return [(radius_x * math.cos(angle), radius_y * math.sin(angle)) for angle in angles]


def _extruded(polygon: list[tuple[float, float]], height: float, top: float = 1.0) -> trimesh.Trimesh:
    """Return the hull of a polygon at z = −height/2 and the same scaled by `top` at z = height/2."""
    lower = [[x, y, -height / 2] for x, y in polygon]
    upper = [[top * x, top * y, height / 2] for x, y in polygon] if top > 0 else [[0.0, 0.0, height / 2]]
    return _hull(lower + upper)


def cuboid(sides: tuple[float, float, float], centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    """Return a box with the given side lengths, parallel to the axes."""
    corners = [[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
    return _hull(np.array(corners) * sides + centre)


def box(rng: Generator) -> Parts:
    """Draw a box from a cube to a bar or a thick board."""
    return [cuboid((1.0, rng.uniform(0.4, 1.0), rng.uniform(0.35, 0.9)))]


def prism(rng: Generator) -> Parts:
    """Draw a prism over a polygon of 3, 5, 6 or 8 sides, up to 40 % flattened, sometimes slanted."""
    sides = int(rng.choice([3, 5, 6, 8]))
    polygon = _polygon(sides, 0.5, rng.uniform(0.3, 0.5), rng.uniform(0, math.pi))
    return [_extruded(polygon, rng.uniform(0.5, 1.8))]


def cylinder(rng: Generator) -> Parts:
    """Draw a cylinder of 12 sides, round or elliptic, from a disc to a rod."""
    flattening = rng.uniform(0.6, 1.0) if rng.random() < 0.3 else 1.0
    return [_extruded(_polygon(CIRCLE_SIDES, 0.5, 0.5 * flattening), rng.uniform(0.5, 2.2))]


def frustum(rng: Generator) -> Parts:
    """Draw a cone, a pyramid or a frustum of 4, 6 or 12 sides."""
    sides = int(rng.choice([4, 6, CIRCLE_SIDES]))
    top = 0.0 if rng.random() < 0.25 else rng.uniform(0.25, 0.75)
    return [_extruded(_polygon(sides, 0.5, rng.uniform(0.4, 0.5), math.pi / 4), rng.uniform(0.7, 1.7), top)]


def superquadric(rng: Generator) -> Parts:
    """Draw a superquadric between a rounded box, an ellipsoid and a rounded octahedron.

    x = a cⁿ(η) cᵐ(ω), y = b cⁿ(η) sᵐ(ω), z = c sⁿ(η), with cⁿ = sign(cos)·|cos|ⁿ; convex for exponents n, m ≤ 2.

    Source: Barr 1981, Superquadrics and angle-preserving transformations.
    """
    radii = (0.5, rng.uniform(0.3, 0.5), rng.uniform(0.3, 0.5))
    n, m = rng.uniform(0.35, 1.5), rng.uniform(0.35, 1.5)
    points = [[0.0, 0.0, -radii[2]], [0.0, 0.0, radii[2]]]
    for latitude in (-0.95, -0.475, 0.0, 0.475, 0.95):
        for longitude in range(8):
            angle = 2 * math.pi * longitude / 8
            ring = _signed_power(math.cos(latitude), n)
            points.append(
                [
                    radii[0] * ring * _signed_power(math.cos(angle), m),
                    radii[1] * ring * _signed_power(math.sin(angle), m),
                    radii[2] * _signed_power(math.sin(latitude), n),
                ]
            )
    return [_hull(points)]


def _signed_power(value: float, exponent: float) -> float:
    # What should be zero is 1e-17 here, and a small exponent would blow that up.
    return math.copysign(abs(value) ** exponent, value) if abs(value) > 1e-9 else 0.0


def stone(rng: Generator) -> Parts:
    """Draw the hull of 10 to 20 random points near an ellipsoid."""
    directions = rng.normal(size=(int(rng.integers(10, 21)), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radii = np.array([0.5, rng.uniform(0.3, 0.5), rng.uniform(0.25, 0.45)])
    return [_hull(directions * radii * rng.uniform(0.75, 1.0, size=(len(directions), 1)))]


def ring(rng: Generator) -> Parts:
    """Draw a ring or an open arc, of 4 to 8 convex pieces, round or elliptic, with 4 or 6 sides in cross-section."""
    closed = rng.random() < 0.7
    pieces = int(rng.integers(6, 9)) if closed else int(rng.integers(4, 7))
    arc = 2 * math.pi if closed else rng.uniform(0.55, 0.75) * 2 * math.pi
    middle, radial, axial = 0.5, rng.uniform(0.10, 0.15), rng.uniform(0.20, 0.32)
    stretch = rng.uniform(1.0, 1.5)
    section = [(radial, axial), (-radial, axial), (-radial, -axial), (radial, -axial)]
    if rng.random() < 0.5:
        section = [(0.6 * r, z) for r, z in section] + [(radial, 0.0), (-radial, 0.0)]
    rims = []
    for step in range(pieces + 1):
        angle = arc * step / pieces
        x, y = stretch * math.cos(angle), math.sin(angle)
        rims.append([[(middle + r) * x, (middle + r) * y, z] for r, z in section])
    return [_hull(first + second) for first, second in itertools.pairwise(rims)]


def bracket(rng: Generator) -> Parts:
    """Draw an L, T, U or Z of two or three boxes that overlap at the corners."""
    form = str(rng.choice(["L", "T", "U", "Z"]))
    depth, thickness = rng.uniform(0.35, 0.6), rng.uniform(0.25, 0.38)
    width, rise = rng.uniform(0.9, 1.2), rng.uniform(0.5, 0.9)
    side, up = (width - thickness) / 2, (rise - thickness) / 2
    base = cuboid((width, depth, thickness))
    right = cuboid((thickness, depth, rise), (side, 0.0, up))
    if form == "L":
        return [base, right]
    if form == "T":
        return [base, cuboid((thickness, depth, rise), (rng.uniform(-0.3, 0.3) * side, 0.0, up))]
    if form == "U":
        left_rise = rise * rng.uniform(0.7, 1.0)
        return [base, right, cuboid((thickness, depth, left_rise), (-side, 0.0, (left_rise - thickness) / 2))]
    return [base, right, cuboid((thickness, depth, rise), (-side, 0.0, -up))]


FAMILIES: dict[str, Callable[[Generator], Parts]] = {
    "box": box,
    "prism": prism,
    "cylinder": cylinder,
    "frustum": frustum,
    "superquadric": superquadric,
    "stone": stone,
    "ring": ring,
    "bracket": bracket,
}
COMPOSITE = ("ring", "bracket")
SIMPLE = tuple(name for name in FAMILIES if name not in COMPOSITE)


def rotation(rng: Generator) -> Array:
    """Draw a rotation matrix [3, 3], uniform over all rotations (a normalised Gaussian quaternion)."""
    turn: Array = Rotation.from_quat(rng.normal(size=4), scalar_first=True).as_matrix()
    return turn


def draw_shape(rng: Generator, family: str) -> Shape:
    """Draw an object of a main family with zero to three smaller convex parts grown into it.

    Args:
        rng: takes all randomness.
        family: one of `FAMILIES`.

    Returns:
        At most 4 parts; at most 8 where the main family is a ring or a bracket, whose pieces count.
    """
    parts = FAMILIES[family](rng)
    families = [family]
    if family in COMPOSITE:
        extra = int(rng.random() < 0.3 and len(parts) < MOST_PARTS)
    else:
        extra = int(rng.choice(4, p=[0.15, 0.35, 0.3, 0.2]))
    main = list(parts)
    for _ in range(extra):
        name = str(rng.choice(SIMPLE))
        parts.append(_grown_on(rng, main, FAMILIES[name](rng)[0], rng.uniform(0.4, 0.8)))
        families.append(name)
    return Shape(tuple(parts), tuple(families))


def _grown_on(rng: Generator, main: Parts, addition: trimesh.Trimesh, size: float) -> trimesh.Trimesh:
    """Return `addition`, scaled and turned, with its centre a little under the surface of one of the main parts."""
    host = main[int(rng.integers(len(main)))]
    corners = host.vertices[host.faces[int(rng.choice(len(host.faces), p=host.area_faces / host.area))]]
    surface = rng.dirichlet([1.0, 1.0, 1.0]) @ corners
    centre = host.vertices.mean(axis=0)
    turned = rng.permutation(3) if rng.random() < 0.5 else None
    # Its vertices' mean lies inside any convex part, so the two are sure to meet.
    own = addition.vertices - addition.vertices.mean(axis=0)
    points = own[:, turned] if turned is not None else own @ rotation(rng).T
    scale = size * float(np.ptp(host.vertices, axis=0).max()) / float(np.ptp(points, axis=0).max())
    return _hull(points * scale + centre + rng.uniform(0.7, 1.0) * (surface - centre))
