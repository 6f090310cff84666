"""The Panda of pybullet_data, made light: symmetrised low-polygon hulls to look at, boxes for finger collision.

The original meshes cost ten times the time of all the rest of a frame, and their small asymmetries would break the
mirror symmetry of the scene. The model is derived by a deterministic rule, once, into the user's cache.
"""

import dataclasses
import functools
import hashlib
import math
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pybullet_data
import trimesh

from graspq.common.files import cache_folder, committed_folder
from graspq.common.provenance import versions

URDF_NAME = "panda.urdf"
ARM_JOINTS = (0, 1, 2, 3, 4, 5, 6)
HAND_LINK = 8
FINGER_LINKS = (9, 10)
FINGER_OPENING = 0.04  # metres each finger travels
FINGER_TIP = 0.0536  # metres from the finger's frame to its tip
_PAD_SIZE = (0.022, 0.014, 0.052)  # width along x, depth along the closing direction, length along z; metres
_VISUAL_VERTICES = 26
# The arm's own dynamics are not the subject: a light arm follows its set-points with forces that objects survive.
_MASS_SCALE = 0.2
_COLORS = {"link": "0.88 0.88 0.90 1", "dark": "0.22 0.23 0.25 1", "finger": "0.10 0.10 0.11 1"}
# Each link's plane of symmetry by its normal in the link's frame: where joints 1, 3 and 5 are at zero all of these
# planes are y = 0 of the world. Link 7 turns with the hand, whose two planes stand at 45 degrees in its frame.
_DIAGONALS = ((math.sqrt(0.5), math.sqrt(0.5), 0.0), (math.sqrt(0.5), -math.sqrt(0.5), 0.0))
_SYMMETRY = {
    "link0": ((0, 1, 0),),
    "link1": ((0, 1, 0),),
    "link2": ((0, 0, 1),),
    "link3": ((0, 1, 0),),
    "link4": ((0, 0, 1),),
    "link5": ((0, 1, 0),),
    "link6": ((0, 0, 1),),
    "link7": _DIAGONALS,
    "hand": ((1, 0, 0), (0, 1, 0)),
    "finger": ((1, 0, 0),),
}


@functools.cache
def panda_urdf() -> Path:
    """Return the path of the light Panda's URDF; made on the first call on this machine."""
    source = Path(pybullet_data.getDataPath()) / "franka_panda"
    folder = cache_folder("panda", _key(source))
    if not folder.is_dir():
        with committed_folder(folder) as temporary:
            _derive(source, temporary)
    return folder / URDF_NAME


@dataclasses.dataclass(frozen=True)
class VisibleLink:
    """What is seen of a link: `vertices` [V, 3] metres in its frame, `faces` [F, 3], `color` RGBA in 0..1."""

    link: int
    vertices: np.ndarray
    faces: np.ndarray
    color: tuple[float, ...]


@functools.cache
def visible_links() -> tuple[VisibleLink, ...]:
    """Return what is seen of the light Panda but its base, which the camera never sees."""
    meshes = {link: f"link{link + 1}" for link in ARM_JOINTS} | {HAND_LINK: "hand"}
    meshes |= dict.fromkeys(FINGER_LINKS, "finger")
    found = []
    for link, name in meshes.items():
        mesh = trimesh.load(panda_urdf().with_name(f"{name}.obj"), force="mesh", process=False)
        vertices, places = np.unique(mesh.vertices, axis=0, return_inverse=True)
        if link == FINGER_LINKS[1]:
            # The first finger after half a turn about z.
            vertices = vertices * (-1.0, -1.0, 1.0)
        color = tuple(float(word) for word in _COLORS[_color_of(name)].split())
        found.append(VisibleLink(link, vertices, places[mesh.faces], color))
    return tuple(found)


def _color_of(mesh: str) -> str:
    return "finger" if mesh == "finger" else "dark" if mesh in ("hand", "link7", "link3", "link5") else "link"


def _key(source: Path) -> str:
    """Return a digest of all that the model depends on: this rule, the original, and who computes the hulls."""
    originals = [source / URDF_NAME, *(_original(source, name) for name in _SYMMETRY)]
    content = b"".join(path.read_bytes() for path in (Path(__file__), *originals))
    return hashlib.sha256(content + repr(versions("numpy", "scipy", "trimesh")).encode()).hexdigest()


def _original(source: Path, name: str) -> Path:
    return source / "meshes" / "collision" / f"{name}.obj"


def _derive(source: Path, folder: Path) -> None:
    for name, normals in _SYMMETRY.items():
        mesh = trimesh.load(_original(source, name), force="mesh", process=False)
        _write_flat_obj(folder / f"{name}.obj", symmetric_hull(np.asarray(mesh.vertices), normals))
    tree = ElementTree.parse(source / URDF_NAME)
    for link in tree.getroot().iter("link"):
        _lighten(link)
    for element in tree.getroot().findall("material"):
        tree.getroot().remove(element)
    tree.write(folder / URDF_NAME)


def symmetric_hull(vertices: np.ndarray, normals: tuple[tuple[float, ...], ...]) -> trimesh.Trimesh:
    """Return a convex hull of few vertices that is exactly symmetric about the given planes through the origin.

    Args:
        vertices: [V, 3] metres.
        normals: unit normals of the planes of symmetry.
    """
    points = trimesh.convex.convex_hull(vertices).vertices
    kept = _spread_points(points, max(8, _VISUAL_VERTICES // 2 ** len(normals)))
    for normal in normals:
        direction = np.asarray(normal, dtype=float)
        kept = np.concatenate([kept, kept - 2.0 * (kept @ direction)[:, None] * direction])
    return trimesh.convex.convex_hull(np.unique(kept.round(7), axis=0))


def _spread_points(points: np.ndarray, count: int) -> np.ndarray:
    """Farthest-point subset: the point farthest from the centre, then always the one farthest from those chosen."""
    chosen = [int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    subset: np.ndarray = points[np.asarray(chosen)]
    return subset


def _write_flat_obj(path: Path, mesh: trimesh.Trimesh) -> None:
    """Write a mesh with one normal a face, so that it is shaded flat."""
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in mesh.vertices]
    lines += [f"vn {x:.6f} {y:.6f} {z:.6f}" for x, y, z in mesh.face_normals]
    lines += [" ".join(["f", *(f"{v + 1}//{n + 1}" for v in face)]) for n, face in enumerate(mesh.faces)]
    path.write_text("\n".join(lines) + "\n")


def _lighten(link: ElementTree.Element) -> None:
    """Replace a link's meshes: hulls to look at; collision shapes only for the hand and, as boxes, the fingers."""
    name = link.get("name", "").removeprefix("panda_")
    hand = name == "hand"
    finger = name in ("leftfinger", "rightfinger")
    for contact in link.findall("contact"):
        link.remove(contact)  # soft, damped contacts let objects creep out of the gripper at this time step
    for values in [*link.iterfind("inertial/mass"), *link.iterfind("inertial/inertia")]:
        for key, value in values.attrib.items():
            values.set(key, repr(float(value) * _MASS_SCALE))
    for visual in link.findall("visual"):
        mesh = visual.find("geometry/mesh")
        if mesh is None:
            continue
        mesh.set("filename", re.sub(r".*/", "", mesh.get("filename", "")))
        _set_material(visual, _color_of("finger" if finger else name))
    for collision in link.findall("collision"):
        geometry = collision.find("geometry")
        if geometry is None or not (hand or finger):
            link.remove(collision)
        elif hand:
            geometry.find("mesh").set("filename", "hand.obj")  # type: ignore[union-attr]
        else:
            _box_collision(collision, geometry, side=1.0 if name == "leftfinger" else -1.0)


def _box_collision(collision: ElementTree.Element, geometry: ElementTree.Element, side: float) -> None:
    for child in [*geometry, *collision.findall("origin")]:
        (geometry if child in list(geometry) else collision).remove(child)
    ElementTree.SubElement(geometry, "box", size=" ".join(map(str, _PAD_SIZE)))
    offset = f"0 {side * _PAD_SIZE[1] / 2} {FINGER_TIP - _PAD_SIZE[2] / 2}"
    ElementTree.SubElement(collision, "origin", xyz=offset, rpy="0 0 0")


def _set_material(visual: ElementTree.Element, color: str) -> None:
    for material in visual.findall("material"):
        visual.remove(material)
    material = ElementTree.SubElement(visual, "material", name=f"graspq_{color}")
    ElementTree.SubElement(material, "color", rgba=_COLORS[color])
