"""One object before it is a file: convex parts in the body frame, with mass, inertia and colour.

The body frame has its origin at the centre of mass and its axes along the principal axes of inertia, so the inertia is
diagonal and a simulator's base frame is the mesh frame.
"""

import colorsys
import dataclasses
from collections.abc import Sequence

import numpy as np
import trimesh

from graspq.objects.geometry import Array, principal_axes, union_mass_properties

# 0.1 micrometre: what an OBJ file keeps of a coordinate.
COORDINATE_DECIMALS = 7
Color = tuple[float, float, float, float]


@dataclasses.dataclass(frozen=True)
class ObjectModel:
    """A rigid body; see the module for its frame.

    `parts`: convex, watertight, faces outward, metres; `mass` kg; `inertia` [3] principal moments, kg m²; `volume` m³;
    `color` (r, g, b, a) in [0, 1].
    """

    object_id: str
    split: str
    families: tuple[str, ...]
    color: Color
    parts: tuple[trimesh.Trimesh, ...]
    mass: float
    inertia: tuple[float, float, float]
    volume: float

    @property
    def extents(self) -> tuple[float, float, float]:
        """Side lengths of the axis-parallel bounding box in the body frame, metres."""
        points = np.concatenate([part.vertices for part in self.parts])
        x, y, z = (round(float(length), COORDINATE_DECIMALS) for length in np.ptp(points, axis=0))
        return x, y, z


@dataclasses.dataclass(frozen=True)
class Solid:
    """Convex parts in the body frame, of no size or density yet: their union's volume and principal moments [3]."""

    parts: tuple[trimesh.Trimesh, ...]
    volume: float
    moments: Array

    @classmethod
    def of(cls, parts: Sequence[trimesh.Trimesh]) -> "Solid":
        """Move convex parts into the body frame of their union."""
        properties = union_mass_properties(parts)
        moments, axes = principal_axes(properties.inertia)
        # On a grid, so that a last-bit difference between machines cannot reach the vertices.
        centre = np.round(properties.centre, COORDINATE_DECIMALS)
        moved = tuple(
            trimesh.Trimesh((part.vertices - centre) @ axes, part.faces, process=False, validate=False)
            for part in parts
        )
        return cls(moved, properties.volume, moments)

    @property
    def points(self) -> Array:
        """All vertices of all parts [V, 3]."""
        return np.concatenate([part.vertices for part in self.parts])

    def model(
        self, *, object_id: str, split: str, families: Sequence[str], color: Color, mass: float, scale: float = 1.0
    ) -> ObjectModel:
        """Return the object of this shape, `scale` times as large and of `mass` kg."""
        volume = self.volume * scale**3
        x, y, z = (_significant(moment * scale**5 * mass / volume) for moment in self.moments)
        parts = tuple(
            trimesh.Trimesh(_on_grid(part.vertices * scale), part.faces, process=False, validate=False)
            for part in self.parts
        )
        return ObjectModel(
            object_id=object_id,
            split=split,
            families=tuple(families),
            color=color,
            parts=parts,
            mass=_significant(mass),
            inertia=(x, y, z),
            volume=_significant(volume),
        )


def _on_grid(vertices: Array) -> Array:
    # Adding zero turns −0.0 into 0.0, which prints differently.
    rounded: Array = np.round(vertices, COORDINATE_DECIMALS) + 0.0
    return rounded


def _significant(value: float) -> float:
    """Return `value` rounded to seven significant digits."""
    return float(f"{value:.6e}")


def draw_color(rng: np.random.Generator) -> Color:
    """Draw a colour of any hue, from dark to pale and from grey to saturated: a quarter are nearly grey."""
    saturation = rng.uniform(0.0, 0.12) if rng.random() < 0.25 else rng.uniform(0.12, 0.95)
    red, green, blue = colorsys.hsv_to_rgb(rng.uniform(), saturation, rng.uniform(0.3, 1.0))
    return round(red, 3), round(green, 3), round(blue, 3), 1.0
