"""An object set on disk: `object_set.json` and, for each object, an OBJ and a URDF.

Procedural, targeted and third-party sets are all held by this one interface.
"""

import dataclasses
import functools
import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import trimesh

from graspq.common.errors import UserError
from graspq.common.files import read_json, sha256_of
from graspq.objects.export import read_obj_parts
from graspq.objects.model import Color
from graspq.objects.publishing import MANIFEST, published

FORMAT_VERSION = 1


@dataclasses.dataclass(frozen=True)
class ObjectRecord:
    """What a set says of one object.

    `families`: where its parts came from, the main one first; `color` (r, g, b, a) in [0, 1]; `mass` kg; `inertia` [3]
    principal moments, kg m²; `volume` m³ of the union of its parts; `extents` [3] m, in the body frame; `parts`: number
    of convex parts; `mesh` and `urdf`: paths relative to the set's folder; `sha256`: digest of each of these files.
    """

    object_id: str
    split: str
    families: tuple[str, ...]
    color: Color
    mass: float
    inertia: tuple[float, float, float]
    volume: float
    extents: tuple[float, float, float]
    parts: int
    mesh: str
    urdf: str
    sha256: dict[str, str]

    def to_json(self) -> dict[str, Any]:
        """Return the record as plain JSON values."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "ObjectRecord":
        """Return the record that `to_json` wrote.

        Raises:
            KeyError, TypeError, ValueError: a field is missing, unknown or of the wrong kind.
        """
        known = {field.name for field in dataclasses.fields(cls)}
        if set(values) != known:
            raise ValueError(f"expected the fields {', '.join(sorted(known))}")
        red, green, blue, alpha = (float(value) for value in values["color"])
        inertia, extents = ([float(value) for value in values[name]] for name in ("inertia", "extents"))
        if len(inertia) != 3 or len(extents) != 3 or not values["mass"] > 0:
            raise ValueError("inertia and extents are three numbers each, and a mass is above 0")
        return cls(
            object_id=str(values["object_id"]),
            split=str(values["split"]),
            families=tuple(str(family) for family in values["families"]),
            color=(red, green, blue, alpha),
            mass=float(values["mass"]),
            inertia=(inertia[0], inertia[1], inertia[2]),
            volume=float(values["volume"]),
            extents=(extents[0], extents[1], extents[2]),
            parts=int(values["parts"]),
            mesh=str(values["mesh"]),
            urdf=str(values["urdf"]),
            sha256={str(path): str(digest) for path, digest in values["sha256"].items()},
        )


@dataclasses.dataclass(frozen=True)
class ObjectSet:
    """A set of objects; `objects` keeps the order of `object_set.json`.

    `name`: what it is, such as "procedural"; `generator_version` and `seed`: what made it, None for third-party meshes.
    """

    folder: Path
    name: str
    generator_version: str | None
    seed: int | None
    objects: tuple[ObjectRecord, ...]
    sha256: str

    @classmethod
    def load(cls, folder: Path | str) -> "ObjectSet":
        """Read a set's `object_set.json`; the meshes are read when they are needed and checked by `verify`.

        Raises:
            UserError: there is no object set, or not one that this version reads.
        """
        folder = Path(folder)
        path = folder / MANIFEST
        values = read_json(path, "object set (make one with grasp-objects make)")
        try:
            if values["format_version"] != FORMAT_VERSION:
                raise UserError(
                    f"{path}: format_version {values['format_version']!r}, expected {FORMAT_VERSION}; make it again"
                )
            objects = tuple(ObjectRecord.from_json(record) for record in values["objects"])
            version, seed = values["generator_version"], values["seed"]
            loaded = cls(folder, str(values["name"]), version, seed, objects, sha256_of(path))
        except UserError:
            raise
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise UserError(f"{path}: not a readable object set ({error!r}); make the set again") from None
        if not objects or len(loaded._by_id) != len(objects):
            raise UserError(f"{path}: expected one or more objects with ids of their own; make the set again")
        for record in objects:
            if any((folder / file).is_symlink() or not _inside(file) for file in record.sha256):
                raise UserError(f"{path}: the files of {record.object_id} must lie inside the set's folder")
        return loaded

    @functools.cached_property
    def _by_id(self) -> dict[str, ObjectRecord]:
        return {record.object_id: record for record in self.objects}

    def __len__(self) -> int:
        """Return the number of objects."""
        return len(self.objects)

    def __getitem__(self, object_id: str) -> ObjectRecord:
        """Return the record of one object.

        Raises:
            UserError: the set has no such object.
        """
        if object_id not in self._by_id:
            raise UserError(f"{self.folder}: no object {object_id!r}; the first of {len(self)} is {self.ids()[0]!r}")
        return self._by_id[object_id]

    @property
    def splits(self) -> tuple[str, ...]:
        """Names of the splits, in order of first appearance."""
        return tuple(dict.fromkeys(record.split for record in self.objects))

    def ids(self, split: str | None = None) -> tuple[str, ...]:
        """Return the ids of one split, or of all, in the set's order.

        Raises:
            UserError: the set has no such split.
        """
        if split is not None and split not in self.splits:
            raise UserError(f"{self.folder}: no split {split!r}; choose from {', '.join(self.splits)}")
        return tuple(record.object_id for record in self.objects if split in (None, record.split))

    def parts_of(self, object_id: str) -> tuple[trimesh.Trimesh, ...]:
        """Return the convex parts of one object in its body frame, metres.

        Raises:
            UserError: no such object, or its mesh is unreadable.
        """
        return read_obj_parts(self.folder / self[object_id].mesh)

    def digest(self) -> str:
        """Return the SHA-256 of `object_set.json`, which holds those of all other files."""
        return self.sha256

    def verify(self) -> None:
        """Check every file against its SHA-256.

        Raises:
            UserError: naming the first file that is missing or differs.
        """
        for record in self.objects:
            for file, expected in record.sha256.items():
                _check(self.folder / file, expected)
        _check(self.folder / MANIFEST, self.sha256)

    def copy_to(self, folder: Path | str) -> "ObjectSet":
        """Copy the set byte for byte and return the copy; an identical copy that is there already is kept.

        Raises:
            UserError: a file of this set is damaged, or the folder holds something else.
        """
        folder = Path(folder)
        self.verify()
        with published(folder, what="object set") as temporary:
            for file in (MANIFEST, *(file for record in self.objects for file in record.sha256)):
                (temporary / file).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(self.folder / file, temporary / file)
        copy = ObjectSet.load(folder)
        copy.verify()
        return copy


def _inside(file: str) -> bool:
    path = Path(file)
    return not path.is_absolute() and ".." not in path.parts


def _check(path: Path, expected: str) -> None:
    try:
        actual = sha256_of(path)
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); make the object set again") from None
    if actual != expected:
        raise UserError(f"{path}: damaged, its SHA-256 is not the one in {MANIFEST}; make the object set again")


def manifest_text(*, name: str, generator_version: str | None, seed: int | None, records: list[ObjectRecord]) -> str:
    """Return `object_set.json`: the header, then one object a line so that differences are easy to read."""
    header = {
        "format_version": FORMAT_VERSION,
        "name": name,
        "generator_version": generator_version,
        "seed": seed,
    }
    lines = [f"  {json.dumps(key)}: {json.dumps(value)}," for key, value in header.items()]
    objects = ",\n".join("    " + json.dumps(record.to_json(), ensure_ascii=False) for record in records)
    return "{\n" + "\n".join(lines) + '\n  "objects": [\n' + objects + "\n  ]\n}\n"


def sha256_of_text(text: str) -> str:
    """Return the SHA-256 of a text's UTF-8 bytes."""
    return hashlib.sha256(text.encode()).hexdigest()
