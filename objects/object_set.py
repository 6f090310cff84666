"""An object set on disk: `object_set.json` and, for each object, an OBJ and a URDF.

Procedural, targeted and third-party sets are all held by this one interface.
"""

import dataclasses
import functools
import json
import math
import re
import shutil
import stat
from pathlib import Path
from typing import Any

import trimesh

from graspq.common.errors import CommandError, UserError, told
from graspq.common.files import read_json, sha256_of
from graspq.objects.mesh_files import read_obj_parts, urdf_text
from graspq.objects.model import Color
from graspq.objects.publishing import CHECKSUM, MANIFEST, checksum_text, published

FORMAT_VERSION = 1
_PLAIN_NAME = re.compile(r"\w[\w.-]{0,199}", re.ASCII)
LARGEST = 1000.0  # metres and kilograms, and powers of them: far beyond what a gripper meets


def mesh_file(object_id: str) -> str:
    """Return the path of an object's OBJ, relative to its set's folder."""
    return f"meshes/{object_id}.obj"


def urdf_file(object_id: str) -> str:
    """Return the path of an object's URDF, relative to its set's folder."""
    return f"meshes/{object_id}.urdf"


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

    @property
    def family(self) -> str:
        """The main family."""
        return self.families[0]

    def to_json(self) -> dict[str, Any]:
        """Return the record as plain JSON values."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "ObjectRecord":
        """Return the record that `to_json` wrote.

        Raises:
            KeyError, TypeError, ValueError, AttributeError: a field is missing, unknown, or not as expected.
        """
        fields: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in values.items()
        }
        record = cls(**fields)
        if not all(isinstance(word, str) for word in (record.object_id, record.split, *record.families)):
            raise ValueError("expected words for object_id, split and families")
        if not _PLAIN_NAME.fullmatch(record.object_id):
            raise ValueError(f"object_id {record.object_id!r}: expected letters, digits, '_', '.' and '-'")
        # A set names no files but its own.
        files = mesh_file(record.object_id), urdf_file(record.object_id)
        digests = record.sha256 if isinstance(record.sha256, dict) else {}
        if (record.mesh, record.urdf) != files or set(digests) != set(files):
            raise ValueError(f"{record.object_id}: expected the files {files[0]} and {files[1]}")
        positive = (record.mass, record.volume, *record.inertia, *record.extents)
        numbers = (*positive, *record.color)
        if [len(record.inertia), len(record.extents), len(record.color)] != [3, 3, 4] or not all(
            isinstance(number, int | float) and math.isfinite(number) for number in numbers
        ):
            raise ValueError(f"{record.object_id}: expected finite numbers, three or four where there are several")
        if not 0 < min(positive) <= max(positive) <= LARGEST or not all(0 <= share <= 1 for share in record.color):
            raise ValueError(f"{record.object_id}: expected sizes above 0 to {LARGEST:g} and colours of 0 to 1")
        return record


@dataclasses.dataclass(frozen=True)
class ObjectSet:
    """A set of objects; `objects` keeps the order of `object_set.json`.

    `name`: what it is, such as "procedural"; `generator_version` and `seed`: what made it, None for third-party meshes;
    `sha256`: digest of `object_set.json`, which holds those of all other files.
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
            version = values["format_version"]
            if version == FORMAT_VERSION:
                objects = tuple(ObjectRecord.from_json(record) for record in values["objects"])
                origin = str(values["name"]), values["generator_version"], values["seed"]
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise UserError(f"{path}: not a readable object set ({error!r}); make the set again") from None
        if version != FORMAT_VERSION:
            raise UserError(f"{path}: format_version {version!r}, expected {FORMAT_VERSION}; make it again")
        loaded = cls(folder, *origin, objects, sha256_of(path))
        if not objects or len(loaded._by_id) != len(objects):
            raise UserError(f"{path}: expected one or more objects with ids of their own; make the set again")
        files = (file for record in objects for file in record.sha256)
        if any(_elsewhere(folder / file) for file in ("meshes", *files)):
            raise UserError(
                f"{path}: the files of a set lie in its folder, but a link is among them, or a pipe; copy them there"
            )
        _check_own(path)
        return loaded

    @functools.cached_property
    def _by_id(self) -> dict[str, ObjectRecord]:
        return {record.object_id: record for record in self.objects}

    @functools.cached_property
    def _checked(self) -> set[str]:
        """Ids of the objects whose files `urdf_of` has checked."""
        return set()

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

    def urdf_of(self, object_id: str) -> Path:
        """Return the path of one object's URDF, after checking that a simulator can be given it and its mesh.

        Raises:
            UserError: no such object, its mesh is unreadable, or its URDF says anything but what the record says.
        """
        record = self[object_id]
        path = self.folder / record.urdf
        if object_id in self._checked:
            return path
        self.parts_of(object_id)
        expected = urdf_text(object_id, mass=record.mass, inertia=record.inertia, color=record.color)
        try:
            same = path.read_bytes() == expected.encode()
        except OSError as error:
            raise _unreadable(path, error) from None
        if not same:
            raise UserError(f"{path}: says something else than {MANIFEST}; make the object set again")
        self._checked.add(object_id)
        return path

    def digest(self) -> str:
        """Return the SHA-256 of `object_set.json`, which holds those of all other files."""
        return self.sha256

    def verify(self) -> None:
        """Check every file against its SHA-256.

        Raises:
            UserError: naming the first file that is missing or differs.
        """
        digests = {file: digest for record in self.objects for file, digest in record.sha256.items()}
        for file, expected in {**digests, MANIFEST: self.sha256}.items():
            path = self.folder / file
            try:
                actual = sha256_of(path)
            except OSError as error:
                raise _unreadable(path, error) from None
            if actual != expected:
                raise UserError(f"{path}: damaged, its SHA-256 is not the one in {MANIFEST}; make the object set again")

    def copy_to(self, folder: Path | str) -> "ObjectSet":
        """Copy the set byte for byte and return the copy; an identical copy that is there already is kept.

        Raises:
            UserError: a file of this set is damaged, or the folder holds something else.
        """
        folder = Path(folder)
        self.verify()
        with published(folder) as temporary:
            (temporary / "meshes").mkdir()
            for file in (MANIFEST, *(file for record in self.objects for file in record.sha256)):
                shutil.copyfile(self.folder / file, temporary / file)
            (temporary / CHECKSUM).write_text(checksum_text((temporary / MANIFEST).read_bytes()))
        copy = ObjectSet.load(folder)
        copy.verify()
        return copy


def _elsewhere(path: Path) -> bool:
    """Return whether a path is there and leads elsewhere: a link, a pipe, a device."""
    try:
        mode = path.lstat().st_mode
    except OSError:
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


def _check_own(path: Path) -> None:
    """Check an `object_set.json` against the digest beside it, where there is one."""
    beside = path.with_name(CHECKSUM)
    try:
        if beside.exists() and beside.read_bytes() != checksum_text(path.read_bytes()).encode():
            raise UserError(f"{path}: damaged or edited, its SHA-256 is not that of {CHECKSUM}; make the set again")
    except OSError as error:
        raise _unreadable(beside, error) from None


def _unreadable(path: Path, error: OSError) -> CommandError:
    return told(error, f"{path}: cannot be read ({error.strerror}); make the object set again")


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
