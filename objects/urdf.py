"""Reads what a third-party URDF says of one rigid body: its meshes and where they are, its mass, its colour.

Inertia is not read: it is computed from the shape, since published sets often state placeholders.
"""

import dataclasses
import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from graspq.common.errors import UserError
from graspq.objects.geometry import Array
from graspq.objects.model import Color


@dataclasses.dataclass(frozen=True)
class Source:
    """Meshes with their transforms [4, 4] (scale included) to the body, mass in kg or None, colour or None."""

    meshes: tuple[tuple[Path, Array], ...]
    mass: float | None
    color: Color | None


def read_urdf(path: Path, root: Path) -> Source:
    """Return the one rigid body that a URDF describes; its collision meshes, or the visual ones where there are none.

    Args:
        path: the URDF.
        root: where `package://` paths are searched, besides the URDF's own folder.

    Raises:
        UserError: not a URDF, not one body, no mesh in it, or a mesh that does not exist.
    """
    try:
        robot = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, OSError, ValueError) as error:
        raise UserError(f"{path}: not a readable URDF ({error}); repair or remove it") from None
    links = [
        link for link in robot.iter("link") if link.find("collision") is not None or link.find("visual") is not None
    ]
    if len(links) != 1:
        raise UserError(f"{path}: expected one rigid body, found {len(links)} links with a shape; remove it")
    shapes = links[0].findall("collision") or links[0].findall("visual")
    try:
        meshes = tuple(_mesh(shape, path, root) for shape in shapes)
        mass = _number(links[0].find("inertial/mass"))
        return Source(meshes, mass if mass is not None and mass > 0 else None, _color(links[0], robot))
    except UserError:
        raise
    except ValueError as error:
        raise UserError(f"{path}: not a readable URDF ({error}); repair or remove it") from None


def _mesh(shape: ElementTree.Element, path: Path, root: Path) -> tuple[Path, Array]:
    mesh = shape.find("geometry/mesh")
    if mesh is None or not mesh.get("filename"):
        raise UserError(f"{path}: has a shape that is no mesh; only meshes are read, so replace it by one")
    name = str(mesh.get("filename"))
    relative = name.removeprefix("package://").removeprefix("file://")
    places = [path.parent / relative, root / relative, root.parent / relative]
    # Of a package:// path the first part is the package, which may be `root` itself.
    places += [root / Path(relative).relative_to(Path(relative).parts[0])] if name.startswith("package://") else []
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise UserError(f"{path}: names the mesh {name!r}, which is not there; add it or remove the URDF")
    scale = _numbers(mesh.get("scale"), (1.0, 1.0, 1.0))
    if min(scale) <= 0:
        raise UserError(f"{path}: mesh scale {mesh.get('scale')!r}, expected three numbers above 0")
    transform = _transform(shape.find("origin"))
    transform[:3, :3] *= np.array(scale)
    return found, transform


def _transform(origin: ElementTree.Element | None) -> Array:
    """Return the pose [4, 4] of a URDF `origin`: xyz, then roll, pitch, yaw about fixed axes."""
    pose = np.eye(4)
    if origin is None:
        return pose
    pose[:3, 3] = _numbers(origin.get("xyz"), (0.0, 0.0, 0.0))
    for angle, axis in zip(_numbers(origin.get("rpy"), (0.0, 0.0, 0.0)), range(3), strict=True):
        turn, (i, j) = np.eye(3), ((1, 2), (2, 0), (0, 1))[axis]
        turn[i, i] = turn[j, j] = math.cos(angle)
        turn[j, i], turn[i, j] = math.sin(angle), -math.sin(angle)
        pose[:3, :3] = turn @ pose[:3, :3]
    return pose


def _numbers(text: str | None, default: tuple[float, float, float]) -> tuple[float, float, float]:
    if text is None:
        return default
    values = [float(word) for word in text.split()]
    if len(values) != 3 or not all(math.isfinite(value) for value in values):
        raise ValueError(f"expected three numbers, got {text!r}")
    return values[0], values[1], values[2]


def _number(element: ElementTree.Element | None) -> float | None:
    return None if element is None else float(element.get("value", "nan"))


def _color(link: ElementTree.Element, robot: ElementTree.Element) -> Color | None:
    material = link.find("visual/material")
    if material is None:
        return None
    named = [other for other in robot.findall("material") if other.get("name") == material.get("name")]
    color = next((found for one in (material, *named) if (found := one.find("color")) is not None), None)
    if color is None:
        return None
    values = [min(max(float(word), 0.0), 1.0) for word in color.get("rgba", "").split()]
    if len(values) != 4:
        raise ValueError(f"expected four numbers in rgba, got {color.get('rgba')!r}")
    return values[0], values[1], values[2], values[3]
