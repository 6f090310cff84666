"""Objects as files any simulator reads: one OBJ with an `o` group for each convex part, one URDF that names it.

The same model gives the same bytes.
"""

from collections.abc import Iterator
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import trimesh

from graspq.common.errors import UserError
from graspq.objects.model import COORDINATE_DECIMALS, ObjectModel


def obj_text(model: ObjectModel) -> str:
    """Return the OBJ file: vertices in metres in the body frame, one `o` group a convex part, triangles outward."""
    return "\n".join(_obj_lines(model)) + "\n"


def _obj_lines(model: ObjectModel) -> Iterator[str]:
    yield f"# {model.object_id}: union of {len(model.parts)} convex part(s); metres; origin at the centre of mass"
    first = 1
    for number, part in enumerate(model.parts):
        yield f"o part_{number}"
        for vertex in part.vertices:
            yield "v " + " ".join(f"{value:.{COORDINATE_DECIMALS}f}" for value in vertex)
        for face in part.faces:
            yield "f " + " ".join(str(int(index) + first) for index in face)
        first += len(part.vertices)


def urdf_text(model: ObjectModel, mesh: str) -> str:
    """Return the URDF: one link with the mesh as its shape and its collision shape.

    Args:
        model: the object.
        mesh: path of its OBJ relative to the URDF.
    """
    x, y, z = (repr(value) for value in model.inertia)
    rgba = " ".join(f"{value:g}" for value in model.color)
    geometry = f"<geometry><mesh filename={quoteattr(mesh)}/></geometry>"
    origin = '<origin xyz="0 0 0" rpy="0 0 0"/>'
    lines = [
        '<?xml version="1.0"?>',
        f"<robot name={quoteattr(model.object_id)}>",
        '  <link name="base">',
        "    <inertial>",
        f"      {origin}",
        f'      <mass value="{model.mass!r}"/>',
        f'      <inertia ixx="{x}" ixy="0" ixz="0" iyy="{y}" iyz="0" izz="{z}"/>',
        "    </inertial>",
        "    <visual>",
        f"      {origin}",
        f"      {geometry}",
        f'      <material name="color"><color rgba="{rgba}"/></material>',
        "    </visual>",
        "    <collision>",
        f"      {origin}",
        f"      {geometry}",
        "    </collision>",
        "  </link>",
        "</robot>",
    ]
    return "\n".join(lines) + "\n"


def read_obj_parts(path: Path) -> tuple[trimesh.Trimesh, ...]:
    """Read back what `obj_text` wrote: one mesh for each `o` group.

    Raises:
        UserError: the file is missing or is not such an OBJ.
    """
    vertices: list[list[float]] = []
    groups: list[list[list[int]]] = []
    try:
        for line in path.read_text(encoding="utf-8").splitlines():
            kind, _, rest = line.partition(" ")
            if kind == "o":
                groups.append([])
            elif kind == "v":
                vertices.append([float(word) for word in rest.split()])
            elif kind == "f":
                groups[-1].append([int(word) - 1 for word in rest.split()])
        points = np.array(vertices).reshape(-1, 3)
        parts = []
        for group in groups:
            used = np.unique(np.array(group).reshape(-1, 3))
            faces = np.searchsorted(used, np.array(group))
            parts.append(trimesh.Trimesh(points[used], faces, process=False, validate=False))
    except (OSError, ValueError, IndexError) as error:
        raise UserError(f"{path}: not a readable mesh of an object set ({error}); make the set again") from None
    if not parts:
        raise UserError(f"{path}: holds no parts; make the set again")
    return tuple(parts)
