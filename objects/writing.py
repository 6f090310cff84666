"""Writes objects as an object set: the meshes, the URDFs, and the manifest that names and hashes them."""

import hashlib
from collections.abc import Iterable
from pathlib import Path

from tqdm import tqdm

from graspq.common.errors import UserError
from graspq.objects.mesh_files import obj_text, urdf_text
from graspq.objects.model import ObjectModel
from graspq.objects.object_set import ObjectRecord, ObjectSet, manifest_text, mesh_file, urdf_file
from graspq.objects.publishing import CHECKSUM, MANIFEST, checksum_text, published


def write_object_set(
    folder: Path,
    models: Iterable[ObjectModel],
    *,
    name: str,
    generator_version: str | None = None,
    seed: int | None = None,
    total: int | None = None,
) -> ObjectSet:
    """Write a set in one piece and return it as loaded from disk; an identical set that is there already is kept.

    Args:
        folder: where; missing, empty, or the same set.
        models: one or more objects in the set's order; drawn one by one, so they need not all be in memory.
        name: what the set is, such as "procedural".
        generator_version: version of the rules that made it, None for third-party meshes.
        seed: of the generator, None for third-party meshes.
        total: number of models, for the progress bar (shown on terminals alone).

    Raises:
        UserError: the folder holds something else or cannot be written; or what `models` raises. Nothing is then left.
    """
    _refuse_another_set(folder, (name, generator_version, seed))
    with published(folder) as temporary:
        (temporary / "meshes").mkdir()
        bar = tqdm(models, desc=f"{name} objects", total=total, unit="object", disable=None, leave=False)
        records = [_write_object(temporary, model) for model in bar]
        text = manifest_text(name=name, generator_version=generator_version, seed=seed, records=records)
        (temporary / MANIFEST).write_bytes(text.encode())
        (temporary / CHECKSUM).write_text(checksum_text(text.encode()))
    return ObjectSet.load(folder)


def _refuse_another_set(folder: Path, wanted: tuple[str, str | None, int | None]) -> None:
    """Raise a UserError before any work is done when `folder` holds a set of another origin."""
    if not (folder / MANIFEST).is_file():
        return
    there = ObjectSet.load(folder)
    if (there.name, there.generator_version, there.seed) != wanted:
        origin = f"{there.name}, generator version {there.generator_version}, seed {there.seed}"
        raise UserError(f"{folder}: holds another object set ({origin}); choose another folder or remove this one")


def _write_object(folder: Path, model: ObjectModel) -> ObjectRecord:
    mesh, urdf = mesh_file(model.object_id), urdf_file(model.object_id)
    contents = {
        mesh: obj_text(model.object_id, model.parts).encode(),
        urdf: urdf_text(model.object_id, mass=model.mass, inertia=model.inertia, color=model.color).encode(),
    }
    for file, content in contents.items():
        (folder / file).write_bytes(content)
    return ObjectRecord(
        object_id=model.object_id,
        split=model.split,
        families=model.families,
        color=model.color,
        mass=model.mass,
        inertia=model.inertia,
        volume=model.volume,
        extents=model.extents,
        parts=len(model.parts),
        mesh=mesh,
        urdf=urdf,
        sha256={file: hashlib.sha256(content).hexdigest() for file, content in contents.items()},
    )
