"""Reads what a third-party URDF says of one rigid body: its meshes and where they are, its mass, its colour.

Inertia is not read: it is computed from the shape, since published sets often state placeholders.
"""

import dataclasses
import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from graspq.common.errors import UserError, told
from graspq.objects.geometry import Array
from graspq.objects.model import Color


@dataclasses.dataclass(frozen=True)
class Description:
    """Meshes with their transforms [4, 4] (scale included) to the body, mass in kg or None, colour or None."""

    meshes: tuple[tuple[Path, Array], ...]
    mass: float | None
    color: Color | None


def read_urdf(path: Path, root: Path) -> Description:
    """Return the one rigid body that a URDF describes; its collision meshes, or the visual ones where there are none.

    Args:
        path: the URDF.
        root: the folder that holds all meshes; `package://` paths are searched there.

    Raises:
        UserError: not a URDF, not one body, no mesh in it, or a mesh that does not exist inside `root`.
    """
    try:
        robot = ElementTree.parse(path).getroot()
        links = [
            link for link in robot.iter("link") if link.find("collision") is not None or link.find("visual") is not None
        ]
        if len(links) != 1:
            raise UserError(f"{path}: expected one rigid body, found {len(links)} links with a shape; remove it")
        shapes = links[0].findall("collision") or links[0].findall("visual")
        meshes = tuple(_mesh(shape, path, root) for shape in shapes)
        stated = links[0].find("inertial/mass")
        mass = float(stated.get("value", "nan")) if stated is not None else math.nan
        return Description(meshes, mass if 0 < mass < math.inf else None, _color(links[0], robot))
    except UserError:
        raise
    # A LookupError is an encoding that nobody knows.
    except (ElementTree.ParseError, OSError, ValueError, LookupError) as error:
        raise told(error, f"{path}: not a readable URDF ({error}); repair or remove it") from None


def _mesh(shape: ElementTree.Element, path: Path, root: Path) -> tuple[Path, Array]:
    """Return the mesh of a collision or visual shape and its transform."""
    mesh = shape.find("geometry/mesh")
    if mesh is None or not mesh.get("filename"):
        raise UserError(f"{path}: has a shape that is no mesh; only meshes are read, so replace it by one")
    name = str(mesh.get("filename"))
    relative = Path(name.removeprefix("package://").removeprefix("file://"))
    # Of a package:// path the first part is the package, which may be `root` itself or a folder in it.
    places = [path.parent / relative, root / relative, root / Path(*relative.parts[1:])]
    inside = (place for place in places if place.is_file() and place.resolve().is_relative_to(root.resolve()))
    found = next(inside, None)
    if found is None:
        raise UserError(f"{path}: names the mesh {name!r}, which is not in {root}; add it or remove the URDF")
    scale = _numbers(mesh, "scale", 3, "1 1 1")
    if min(scale) <= 0:
        raise UserError(f"{path}: mesh scale {mesh.get('scale')!r}, expected three numbers above 0")
    origin = shape.find("origin")
    transform = np.eye(4)
    if origin is not None:
        # Roll, pitch and yaw turn about fixed axes.
        transform[:3, :3] = Rotation.from_euler("xyz", _numbers(origin, "rpy", 3, "0 0 0")).as_matrix()
        transform[:3, 3] = _numbers(origin, "xyz", 3, "0 0 0")
    transform[:3, :3] *= scale
    return found, transform


def _color(link: ElementTree.Element, robot: ElementTree.Element) -> Color | None:
    """Return the colour of a link's material, which may be defined with the robot."""
    material = link.find("visual/material")
    if material is None:
        return None
    named = [other for other in robot.findall("material") if other.get("name") == material.get("name")]
    color = next((found for one in (material, *named) if (found := one.find("color")) is not None), None)
    if color is None:
        return None
    red, green, blue, alpha = np.clip(_numbers(color, "rgba", 4, ""), 0.0, 1.0).tolist()
    return red, green, blue, alpha


def _numbers(element: ElementTree.Element, name: str, count: int, default: str) -> list[float]:
    """Return the finite numbers of an attribute.

    Raises:
        ValueError: there are others, or not `count`.
    """
    text = element.get(name, default)
    values = [float(word) for word in text.split()]
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise ValueError(f"{name}: expected {count} numbers, got {text!r}")
    return values
