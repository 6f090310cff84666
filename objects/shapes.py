"""Seeded families of shapes: each draws a list of convex parts, about one unit large.

The maker (`procedural.py`) scales their union to metres, so only proportions are drawn here. Dimension key: S corners
of an outline, K stations of a path.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from graspq.objects.geometry import Array, convex_hull, horizontal_axes

Parts: TypeAlias = list[trimesh.Trimesh]
Generator: TypeAlias = np.random.Generator

# Parts are rounded to this before their hull is taken: a last-bit difference of sin or cos between machines cannot
# change their triangles.
_DECIMALS = 6
MOST_PARTS = 8


@dataclasses.dataclass(frozen=True)
class Shape:
    """Convex parts in one frame (no unit yet), and the families they came from, the main one first."""

    parts: tuple[trimesh.Trimesh, ...]
    families: tuple[str, ...]


def _hull(points: Array | list[list[float]]) -> trimesh.Trimesh:
    return convex_hull(np.round(np.asarray(points, dtype=np.float64), _DECIMALS).astype(np.float64) + 0.0)


def _chained(sections: Sequence[Array]) -> Parts:
    """Return the hull of each two neighbouring point clouds [S, 3]."""
    return [_hull(np.concatenate(pair)) for pair in itertools.pairwise(sections)]


def _polygon(sides: int, radius_x: float = 0.5, radius_y: float = 0.5, turn: float = 0.0) -> Array:
    """Return the corners [S, 2] of a regular polygon, stretched to two radii."""
    angles = turn + 2 * math.pi * np.arange(sides) / sides
    return np.stack([radius_x * np.cos(angles), radius_y * np.sin(angles)], axis=1)


def _rectangle(width: float, depth: float) -> Array:
    """Return the corners [4, 2] of a rectangle."""
    return np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]]) * (width, depth)


def _outline(rng: Generator) -> Array:
    """Draw a cross-section [S, 2], 1 wide: a rectangle or a polygon of 3 to 8 sides, up to 45 % flattened."""
    flat = rng.uniform(0.55, 1.0)
    sides = int(rng.choice([3, 4, 5, 6, 8], p=[0.1, 0.45, 0.1, 0.2, 0.15]))
    return _rectangle(1.0, flat) if sides == 4 else _polygon(sides, 0.5, 0.5 * flat)


def _swept(path: Array, outlines: Sequence[Array]) -> Parts:
    """Return the convex pieces between outlines [K][S, 2] that stand across a path [K, 2] in the plane y = 0.

    The first coordinate of an outline lies in that plane, the second along y.
    """
    tangents = np.gradient(path, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    return _chained(
        [
            np.stack([x - tz * outline[:, 0], outline[:, 1], z + tx * outline[:, 0]], axis=1)
            for (x, z), (tx, tz), outline in zip(path, tangents, outlines, strict=True)
        ]
    )


def _extruded(outline: Array, height: float, top: float = 1.0) -> trimesh.Trimesh:
    """Return the hull of an outline at z = −height/2 and the same scaled by `top` at z = height/2."""
    ends = ((outline, -height / 2), (top * outline, height / 2))
    return _hull(np.concatenate([np.column_stack([corners, np.full(len(corners), z)]) for corners, z in ends]))


def _limb(start: Array, end: Array, outline: Array, tip: float) -> trimesh.Trimesh:
    """Return the hull of an outline [S, 2] across the line at `start` [3] and the same scaled by `tip` at `end` [3]."""
    across = outline @ horizontal_axes((end - start) / np.linalg.norm(end - start)).T
    return _hull(np.concatenate([start + across, end + tip * across]))


def cuboid(sides: tuple[float, float, float], centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    """Return a box with the given side lengths, parallel to the axes."""
    corners = [[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
    return _hull(np.array(corners) * sides + centre)


def box(rng: Generator) -> Parts:
    """Draw a box from a cube to a beam or a thick board."""
    return [cuboid((1.0, rng.uniform(0.3, 1.0), rng.uniform(0.25, 0.9)))]


def prism(rng: Generator) -> Parts:
    """Draw a prism over a polygon of 3, 5, 6 or 8 sides, up to 40 % flattened."""
    sides = int(rng.choice([3, 5, 6, 8]))
    return [_extruded(_polygon(sides, 0.5, rng.uniform(0.3, 0.5), rng.uniform(0, math.pi)), rng.uniform(0.4, 2.2))]


def cylinder(rng: Generator) -> Parts:
    """Draw a cylinder of 8, 12 or 16 sides, round or elliptic, from a disc to a rod."""
    flattening = rng.uniform(0.6, 1.0) if rng.random() < 0.3 else 1.0
    return [_extruded(_polygon(int(rng.choice([8, 12, 16])), 0.5, 0.5 * flattening), rng.uniform(0.4, 3.0))]


def frustum(rng: Generator) -> Parts:
    """Draw a pyramid or a cone with its top cut off, of 4, 6 or 12 sides."""
    sides = int(rng.choice([4, 6, 12]))
    return [_extruded(_polygon(sides, 0.5, rng.uniform(0.4, 0.5), math.pi / 4), rng.uniform(0.6, 1.8),
                      rng.uniform(0.2, 0.8))]  # fmt: skip


def superquadric(rng: Generator) -> Parts:
    """Draw a superquadric between a rounded box, an ellipsoid and a rounded octahedron.

    x = a cⁿ(η) cᵐ(ω), y = b cⁿ(η) sᵐ(ω), z = c sⁿ(η), with cⁿ = sign(cos)·|cos|ⁿ; convex for exponents n, m ≤ 2.

    Source: Barr 1981, Superquadrics and angle-preserving transformations.
    """
    radii = np.array([0.5, rng.uniform(0.25, 0.5), rng.uniform(0.25, 0.5)])
    n, m = rng.uniform(0.35, 1.5), rng.uniform(0.35, 1.5)
    latitude, longitude = np.meshgrid((-0.95, -0.475, 0.0, 0.475, 0.95), 2 * math.pi * np.arange(8) / 8)
    level = _signed_power(np.cos(latitude), n)
    rings = np.stack([level * _signed_power(np.cos(longitude), m), level * _signed_power(np.sin(longitude), m),
                      _signed_power(np.sin(latitude), n)], axis=-1).reshape(-1, 3)  # fmt: skip
    return [_hull(np.concatenate([rings, [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]]) * radii)]


def _signed_power(value: Array, exponent: float) -> Array:
    # What should be zero is 1e-17 here, and a small exponent would blow that up.
    power: Array = np.where(np.abs(value) > 1e-9, np.sign(value) * np.abs(value) ** exponent, 0.0)
    return power


def _pebble(rng: Generator, count: int, radii: Array) -> Array:
    """Draw `count` points [count, 3] near an ellipsoid about the origin."""
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points: Array = directions * radii * rng.uniform(0.75, 1.0, size=(count, 1))
    return points


def stone(rng: Generator) -> Parts:
    """Draw the hull of 10 to 24 random points near an ellipsoid."""
    return [
        _hull(_pebble(rng, int(rng.integers(10, 25)), np.array([0.5, rng.uniform(0.25, 0.5), rng.uniform(0.2, 0.45)])))
    ]


def cluster(rng: Generator) -> Parts:
    """Draw three or four stones along a crooked way, each joined with the next in one hull."""
    centre, clouds = np.zeros(3), []
    for _ in range(int(rng.integers(3, 5))):
        clouds.append(centre + _pebble(rng, int(rng.integers(6, 9)), rng.uniform(0.13, 0.3, size=3)))
        step = rng.normal(size=3) * (1.0, 1.0, 0.6)
        centre = centre + step * rng.uniform(0.3, 0.45) / np.linalg.norm(step)
    return _chained(clouds)


def ring(rng: Generator) -> Parts:
    """Draw a ring or an open arc, of 4 to 8 convex pieces, round or elliptic, with 4 or 6 sides in cross-section."""
    closed = rng.random() < 0.6
    pieces = int(rng.integers(6, 9)) if closed else int(rng.integers(3, 7))
    arc = 2 * math.pi if closed else rng.uniform(0.35, 0.75) * 2 * math.pi
    radial, axial, stretch = rng.uniform(0.09, 0.16), rng.uniform(0.12, 0.34), rng.uniform(1.0, 1.6)
    section = np.array([(radial, axial), (-radial, axial), (-radial, -axial), (radial, -axial)])
    if rng.random() < 0.5:
        section = np.concatenate([section * (0.6, 1.0), [(radial, 0.0), (-radial, 0.0)]])
    radius = 0.5 + section[:, 0]
    return _chained(
        [
            np.stack([stretch * radius * math.cos(angle), radius * math.sin(angle), section[:, 1]], axis=1)
            for angle in np.linspace(0, arc, pieces + 1)
        ]
    )


def bracket(rng: Generator) -> Parts:
    """Draw an L, T, U or Z of two or three boxes that overlap at the corners."""
    form = str(rng.choice(["L", "T", "U", "Z"]))
    depth, thickness = rng.uniform(0.25, 0.6), rng.uniform(0.16, 0.38)
    width, rise = rng.uniform(0.9, 1.2), rng.uniform(0.5, 1.0)
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


def bar(rng: Generator) -> Parts:
    """Draw a straight or bent bar, half of them with a head at one end or at both."""
    thickness, bend, at = rng.uniform(0.13, 0.3), math.radians(rng.uniform(25, 80)), rng.uniform(0.3, 0.7)
    path = np.array([[0.0, 0.0], [1.0, 0.0]])
    if rng.random() < 0.4:
        path = np.array([[0.0, 0.0], [at, 0.0], [at + (1 - at) * math.cos(bend), (1 - at) * math.sin(bend)]])
    parts = _swept(path, [thickness * _outline(rng)] * len(path))
    for x, z in path[[[], [0], [-1], [0, -1]][int(rng.choice(4, p=[0.5, 0.2, 0.2, 0.1]))]]:
        head = rng.uniform(0.12, 0.3), thickness * rng.uniform(1.3, 2.4), thickness * rng.uniform(1.0, 1.8)
        parts.append(cuboid(head, (float(x), 0.0, float(z))))
    return parts


def cross(rng: Generator) -> Parts:
    """Draw two bars that cross in a plane at 50° to 90°, a third of them with a third bar beside or upright."""
    thickness = rng.uniform(0.14, 0.3)
    outline = (
        _rectangle(thickness, thickness * rng.uniform(0.8, 1.3)) if rng.random() < 0.7 else thickness * _outline(rng)
    )
    ends = [np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])]
    third = rng.random()
    for _ in range(2 if third < 0.17 else 1):
        angle, shift = math.radians(rng.uniform(50, 130)), rng.uniform(-0.1, 0.1)
        across = rng.uniform(0.45, 1.0) * np.array([math.cos(angle), math.sin(angle), 0.0])
        middle = np.array([rng.uniform(-0.35, 0.35), 0.0, 0.0])
        ends.append(np.stack([middle + (shift - 0.5) * across, middle + (shift + 0.5) * across]))
    if third > 0.83:
        ends.append(np.array([[0.0, 0.0, -0.5], [0.0, 0.0, 0.5]]) * rng.uniform(0.4, 0.9))
    return [_limb(start, end, outline * rng.uniform(0.8, 1.15), 1.0) for start, end in ends]


def plate(rng: Generator) -> Parts:
    """Draw a thick tile, a roof of two boards, a tray of a board and two or four walls, or a board with a handle."""
    form, depth, thin = (
        str(rng.choice(["tile", "roof", "tray", "handled"])),
        rng.uniform(0.5, 1.0),
        rng.uniform(0.1, 0.16),
    )
    if form == "tile":
        return [
            _extruded(_polygon(int(rng.choice([4, 6, 8, 12])), 0.5, 0.5 * depth, math.pi / 4), rng.uniform(0.2, 0.35))
        ]
    if form == "roof":
        slope, side = math.radians(rng.uniform(20, 55)), rng.uniform(0.35, 0.6)
        fall = np.array([math.cos(slope), -math.sin(slope)])
        return _swept(np.array([side * fall * (-1, 1), [0.0, 0.0], 0.6 * fall]), [_rectangle(thin, depth)] * 3)
    board = cuboid((1.0, depth, thin))
    rise = rng.uniform(0.22, 0.4)
    if form == "handled":
        sides = rng.uniform(0.2, 0.9), rng.uniform(0.13, 0.28), rise
        return [board, cuboid(sides, (rng.uniform(-0.2, 0.2), rng.uniform(-0.15, 0.15), (rise + thin) / 2 - 0.02))]
    walls = [cuboid((thin, depth, rise), (side * (0.5 - thin / 2), 0.0, (rise - thin) / 2)) for side in (-1, 1)]
    if rng.random() < 0.5:
        walls += [cuboid((1.0, thin, rise), (0.0, side * (depth - thin) / 2, (rise - thin) / 2)) for side in (-1, 1)]
    return [board, *walls]


def propeller(rng: Generator) -> Parts:
    """Draw a hub with two to five blades, each pitched by 20° to 80° and wider or narrower at its tip."""
    blades, pitch = int(rng.integers(2, 6)), math.radians(rng.uniform(20, 80))
    blade = _rectangle(rng.uniform(0.2, 0.34), rng.uniform(0.09, 0.14)) @ _turn(pitch)
    reach, tip = rng.uniform(0.4, 0.5), rng.uniform(0.6, 1.2)
    parts = [_extruded(_polygon(int(rng.choice([6, 8])), hub := rng.uniform(0.1, 0.2), hub), rng.uniform(0.2, 0.6))]
    for angle in 2 * math.pi * np.arange(blades) / blades:
        out = np.array([math.cos(angle), math.sin(angle), 0.0])
        frame = np.stack([np.cross([0.0, 0.0, 1.0], out), [0.0, 0.0, 1.0]])
        parts.append(_hull(np.concatenate([blade @ frame, reach * out + tip * blade @ frame])))
    return parts


def branch(rng: Generator) -> Parts:
    """Draw a long body with two to five limbs that stick out of it, all of boxes or all of tapered polygons."""
    body, square = rng.uniform(0.18, 0.36), rng.random() < 0.5
    shapes = [
        _rectangle(1.0, rng.uniform(0.7, 1.0)) if square else _polygon(int(rng.choice([5, 6, 8]))) for _ in range(6)
    ]
    parts = [
        _limb(
            np.array([-0.5, 0.0, 0.0]),
            np.array([0.5, 0.0, 0.0]),
            body * shapes[0],
            1.0 if square else rng.uniform(0.5, 1.0),
        )
    ]
    for shape in shapes[1 : 1 + int(rng.integers(2, 6))]:
        turn, lean = (
            rng.choice(4) * math.pi / 2 if square else rng.uniform(0, 2 * math.pi),
            0.0 if square else rng.uniform(-1, 1),
        )
        foot = np.array([rng.uniform(-0.45, 0.45), 0.0, 0.0])
        out = np.array([lean, math.cos(turn), math.sin(turn)]) / math.hypot(1.0, lean)
        parts.append(
            _limb(
                foot,
                foot + out * (body / 2 + rng.uniform(0.12, 0.4)),
                rng.uniform(0.1, 0.22) * shape,
                1.0 if square else rng.uniform(0.5, 1.0),
            )
        )
    return parts


def lathe(rng: Generator) -> Parts:
    """Draw a turned body of 8 or 10 sides, two to five frustums high: a bottle, a vase, a spool, a mushroom."""
    heights = np.concatenate([[0.0], rng.uniform(0.15, 0.5, size=int(rng.integers(2, 6))).cumsum()])
    radii = rng.uniform(0.14, 0.5, size=len(heights)) * rng.uniform(0.6, 1.0)
    circle = _polygon(int(rng.choice([8, 10])), 1.0, 1.0)
    return _swept(np.stack([np.zeros(len(heights)), heights], axis=1), [radius * circle for radius in radii])


def loft(rng: Generator) -> Parts:
    """Draw two to four pieces between outlines of changing size, flatness and turn along an arc of up to 110°."""
    stations, bend = int(rng.integers(3, 6)), math.radians(rng.uniform(1, 110))
    angles = np.linspace(-bend / 2, bend / 2, stations)
    path = np.stack([np.sin(angles), np.cos(angles)], axis=1) / bend
    outline, wide, spin = _outline(rng), rng.uniform(0.2, 0.45), rng.uniform(-0.5, 0.5)
    shapes = []
    for station in range(stations):
        flat = wide * rng.uniform(0.5, 1.1, size=2)
        shapes.append((outline * flat) @ _turn(spin * station))
    return _swept(path, shapes)


def _turn(angle: float) -> Array:
    """Return the matrix [2, 2] that turns row vectors by an angle."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, s], [-s, c]])


SIMPLE: dict[str, Callable[[Generator], Parts]] = {
    "box": box, "prism": prism, "cylinder": cylinder, "frustum": frustum, "superquadric": superquadric, "stone": stone,
}  # fmt: skip
FAMILIES: dict[str, Callable[[Generator], Parts]] = {
    **SIMPLE,
    "ring": ring, "bracket": bracket, "bar": bar, "cross": cross, "plate": plate, "propeller": propeller,
    "branch": branch, "lathe": lathe, "loft": loft, "cluster": cluster,
}  # fmt: skip


def rotation(rng: Generator) -> Array:
    """Draw a rotation matrix [3, 3], uniform over all rotations (a normalised Gaussian quaternion)."""
    turn: Array = Rotation.from_quat(rng.normal(size=4), scalar_first=True).as_matrix()
    return turn


def draw_shape(rng: Generator, family: str, extras: Sequence[str] = tuple(SIMPLE)) -> Shape:
    """Draw an object of a main family; most of one simple part have one to three smaller ones grown into it.

    Args:
        rng: takes all randomness.
        family: one of `FAMILIES`.
        extras: families of the smaller parts, from `SIMPLE`.

    Returns:
        At most 4 parts of a simple family, at most 8 of another.
    """
    main = FAMILIES[family](rng)
    few = len(main) < MOST_PARTS and len(extras) > 0
    count = int(rng.choice(4, p=[0.35, 0.35, 0.2, 0.1] if family in SIMPLE else [0.8, 0.2, 0.0, 0.0])) * few
    names = [str(name) for name in rng.choice(extras, size=count)] if count else []
    grown = [_grown_on(rng, main, FAMILIES[name](rng)[0], rng.uniform(0.35, 0.8)) for name in names]
    return Shape((*main, *grown), (family, *names))


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
