"""The files of one object, which any simulator reads: an OBJ with an `o` group for each convex part, and a URDF.

The same object gives the same bytes.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import trimesh

from graspq.common.errors import told
from graspq.objects.model import COORDINATE_DECIMALS, Color


def obj_text(object_id: str, parts: Sequence[trimesh.Trimesh]) -> str:
    """Return the OBJ file: vertices in metres in the body frame, one `o` group a convex part, triangles outward."""
    return "\n".join(_obj_lines(object_id, parts)) + "\n"


def _obj_lines(object_id: str, parts: Sequence[trimesh.Trimesh]) -> Iterator[str]:
    yield f"# {object_id}: union of {len(parts)} convex part(s); metres; origin at the centre of mass"
    first = 1
    for number, part in enumerate(parts):
        yield f"o part_{number}"
        for vertex in part.vertices:
            yield "v " + " ".join(f"{value:.{COORDINATE_DECIMALS}f}" for value in vertex)
        for face in part.faces:
            yield "f " + " ".join(str(int(index) + first) for index in face)
        first += len(part.vertices)


def urdf_text(object_id: str, *, mass: float, inertia: tuple[float, float, float], color: Color) -> str:
    """Return the URDF: one link with the OBJ beside it as its shape and its collision shape.

    Args:
        object_id: names the robot and, with `.obj`, the mesh.
        mass: kg.
        inertia: principal moments, kg m².
        color: r, g, b, a in [0, 1].
    """
    x, y, z = inertia
    return f"""\
<?xml version="1.0"?>
<robot name={quoteattr(object_id)}>
  <link name="base">
    <inertial>
      <origin xyz="0 0 0" rpy="0 0 0"/>
      <mass value="{mass!r}"/>
      <inertia ixx="{x!r}" ixy="0" ixz="0" iyy="{y!r}" iyz="0" izz="{z!r}"/>
    </inertial>
    <visual>
      <origin xyz="0 0 0" rpy="0 0 0"/>
      <geometry><mesh filename={quoteattr(f"{object_id}.obj")}/></geometry>
      <material name="color"><color rgba="{" ".join(f"{value:g}" for value in color)}"/></material>
    </visual>
    <collision>
      <origin xyz="0 0 0" rpy="0 0 0"/>
      <geometry><mesh filename={quoteattr(f"{object_id}.obj")}/></geometry>
    </collision>
  </link>
</robot>
"""


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
                groups[-1].append([int(word) for word in rest.split()])
        points = np.array(vertices).reshape(-1, 3)
        if not np.isfinite(points).all() or not groups:
            raise ValueError("no parts, or corners that are not finite")
        parts = []
        for group in groups:
            used, faces = np.unique(np.array(group).reshape(-1, 3), return_inverse=True)
            if used[0] < 1:
                raise ValueError(f"corner {used[0]}")
            parts.append(trimesh.Trimesh(points[used - 1], faces.reshape(-1, 3), process=False, validate=False))
    except (OSError, ValueError, IndexError, OverflowError) as error:
        raise told(error, f"{path}: not a readable mesh of an object set ({error}); make the set again") from None
    return tuple(parts)
