"""Folders of third-party meshes as object sets: OBJ, STL, or URDF as in `pybullet_data/random_urdfs`.

Convex pieces are kept, non-convex ones decomposed (V-HACD): what a simulator collides with is also what is drawn, and
mass and inertia are those of the union of the pieces.
"""

import hashlib
import math
import re
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import trimesh

from graspq.common.errors import UserError
from graspq.common.seeding import generator
from graspq.objects.decomposition import convex_parts
from graspq.objects.geometry import Array
from graspq.objects.model import ObjectModel, Solid, draw_color
from graspq.objects.object_set import ObjectSet
from graspq.objects.urdf import Description, read_urdf
from graspq.objects.writing import write_object_set

SMALLEST, LARGEST = 0.01, 0.30
DENSITY = 450.0
_MESH_SUFFIXES = (".obj", ".stl")


def import_meshes(
    source: Path | str,
    folder: Path | str,
    *,
    scale: float = 1.0,
    density: float | None = None,
    name: str | None = None,
    split: str | None = None,
    left_out: Callable[[str], None] = warnings.warn,
) -> ObjectSet:
    """Make an object set of all usable meshes under `source` and return it.

    Where there are URDFs, they are the objects (one rigid body each) and name their meshes; else every OBJ and STL is
    one. Ids are the files' names. A mesh is unusable where it is unreadable, empty or flat, or its longest side is
    outside 1 cm to 30 cm.

    Args:
        source: folder to search, subfolders included.
        folder: where the set goes; missing, empty, or the same set already.
        scale: metres per unit of the files (a URDF's own mesh scale comes first), > 0.
        density: kg/m³; None takes the mass a URDF states, and 450 kg/m³ where none does.
        name: of the set; None takes the name of `source`.
        split: that all objects are put in; None splits them by `split_of`.
        left_out: called with a line on each object that cannot be used; the others make the set.

    Raises:
        UserError: no such folder, no meshes in it or none that can be used, or the set cannot be written. Nothing is
            then left.
    """
    source = Path(source)
    if not (scale > 0 and math.isfinite(scale)):
        raise UserError(f"--scale: expected a number above 0, got {scale}")
    if density is not None and not (density > 0 and math.isfinite(density)):
        raise UserError(f"--density: expected a number of kg/m³ above 0, got {density}")
    files = _object_files(source)

    def models() -> Iterator[ObjectModel]:
        unusable = list[str]()
        for object_id, path in files.items():
            try:
                model = _model(source, object_id, path, split or split_of(object_id), scale, density)
            except UserError as error:
                unusable.append(error.message)
            else:
                yield model
        if len(unusable) == len(files):
            others = f" (and {len(files) - 1} others cannot be used either)" if len(files) > 1 else ""
            raise UserError(f"{unusable[0]}{others}")
        for line in unusable:
            left_out(f"left out {line}")

    return write_object_set(
        Path(folder), models(), name=name if name is not None else _clean(source.resolve().name), total=len(files)
    )


def _object_files(source: Path) -> dict[str, Path]:
    """Return id → file of each object under `source`, sorted by id."""
    if not source.is_dir():
        raise UserError(f"{source}: no such folder; expected one with OBJ, STL or URDF files")
    # A link may lead anywhere: only what lies here is read.
    every = sorted(path for path in source.rglob("*") if path.is_file() and _lies_in(path, source))
    found = [path for path in every if path.suffix.lower() == ".urdf"]
    found = found or [path for path in every if path.suffix.lower() in _MESH_SUFFIXES]
    if not found:
        raise UserError(f"{source}: no OBJ, STL or URDF files here or in subfolders")
    names = [_clean(path.stem) for path in found]
    if len(set(names)) < len(names):
        names = [_clean("-".join(path.relative_to(source).with_suffix("").parts)) for path in found]
    files = dict(sorted(zip(names, found, strict=True)))
    if len(files) < len(found):
        twice = next(name for name in names if names.count(name) > 1)
        raise UserError(f"{source}: two files would both be the object {twice!r}; rename one of them")
    return files


def _lies_in(path: Path, folder: Path) -> bool:
    return path.resolve().is_relative_to(folder.resolve())


def _clean(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", name).strip("._-") or "object"


def split_of(object_id: str) -> str:
    """Return the split of an object, "train" or "test", by its id alone: an object that is added moves no other.

    Of ids that are numbers those that end in 0 are "test", as in the paper; of others a tenth, by their SHA-256.
    """
    if object_id.isdigit():
        return "test" if object_id.endswith("0") else "train"
    return "test" if int.from_bytes(hashlib.sha256(object_id.encode()).digest()[-6:]) / 2**48 < 0.1 else "train"


def _model(source: Path, object_id: str, path: Path, split: str, scale: float, density: float | None) -> ObjectModel:
    described = Description(((path, np.eye(4)),), mass=None, color=None)
    if path.suffix.lower() == ".urdf":
        described = read_urdf(path, source)
    pieces = [
        mesh.apply_transform(transform).apply_scale(scale)
        for file, transform in described.meshes
        for mesh in _read_meshes(file)
    ]
    _check_size(path, np.concatenate([piece.vertices for piece in pieces]), scale)
    parts, families = convex_parts(pieces, path)
    color = described.color
    if color is None:
        # A function of the id alone, so that an object keeps its colour when others are added.
        key = int.from_bytes(hashlib.sha256(object_id.encode()).digest()[:6], "little")
        color = draw_color(generator("objects/import", key))
    solid = Solid.of(parts)
    mass = described.mass if density is None else None
    if mass is None:
        mass = (density if density is not None else DENSITY) * solid.volume
    return solid.model(object_id=object_id, split=split, families=families, color=color, mass=mass)


def _read_meshes(path: Path) -> list[trimesh.Trimesh]:
    """Return the meshes of a file: the groups of an OBJ one by one, since convex ones may share corners."""
    try:
        options = {"split_objects": True, "split_groups": True, "group_material": False, "skip_materials": True}
        scene = trimesh.load_scene(path, **options)
        meshes = [mesh for mesh in scene.geometry.values() if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces) > 0]
        # As the file has them: the other way leaves out corners that are not finite, which makes it another shape.
        corners = [mesh.vertices for mesh in trimesh.load_scene(path, process=False, **options).geometry.values()]
    except FileNotFoundError:
        raise UserError(f"{path}: no such mesh file") from None
    # The readers of mesh formats raise whatever a damaged file leads them to.
    except Exception as error:
        raise UserError(f"{path}: not a readable mesh ({type(error).__name__}: {error}); repair or remove it") from None
    if not meshes:
        raise UserError(
            f"{path}: an empty mesh or a damaged file, no triangle with finite corners; repair or remove it"
        )
    if not all(np.isfinite(some).all() for some in corners):
        raise UserError(f"{path}: has corners that are not finite numbers; repair or remove it")
    return meshes


def _check_size(path: Path, points: Array, scale: float) -> None:
    longest = float(np.ptp(points, axis=0).max())
    if SMALLEST <= longest <= LARGEST:
        return
    if longest == 0:
        raise UserError(f"{path}: an empty mesh, all its vertices coincide; repair or remove it")
    # Files in millimetres, centimetres or inches are the usual reason; else whatever makes the object 8 cm long.
    common = [factor for factor in (0.001, 0.01, 0.0254, 1000.0, 100.0) if SMALLEST <= longest * factor <= LARGEST]
    advised = scale * (common[0] if common else float(f"{0.08 / longest:.2g}"))
    raise UserError(
        f"{path}: longest side {longest:.4g} m, expected {SMALLEST:g} to {LARGEST:g} m; try --scale {advised:.4g}"
    )
