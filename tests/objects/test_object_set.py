import json
import os
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspq.common.errors import UserError
from graspq.common.files import sha256_of
from graspq.objects.object_set import ObjectRecord, ObjectSet


@pytest.fixture
def copied(small_set: ObjectSet, tmp_path: Path) -> ObjectSet:
    shutil.copytree(small_set.folder, tmp_path / "set")
    return ObjectSet.load(tmp_path / "set")


def test_a_set_is_loaded_as_it_was_made(small_set: ObjectSet) -> None:
    loaded = ObjectSet.load(str(small_set.folder))
    assert loaded == small_set
    assert (loaded.name, loaded.seed, len(loaded)) == ("procedural", 7, 64)
    assert loaded.digest() == sha256_of(small_set.folder / "object_set.json")
    loaded.verify()


def test_a_record_survives_json(small_set: ObjectSet) -> None:
    record = small_set.objects[0]
    assert ObjectRecord.from_json(json.loads(json.dumps(record.to_json()))) == record


def test_the_urdf_states_mass_inertia_colour_and_a_mesh_beside_it(small_set: ObjectSet) -> None:
    for record in small_set.objects:
        path = small_set.folder / record.urdf
        robot = ElementTree.parse(path).getroot()
        meshes = {str(mesh.get("filename")) for mesh in robot.iter("mesh")}
        assert meshes == {Path(record.mesh).name}
        assert (path.parent / meshes.pop()).is_file()
        inertia = robot.find("link/inertial/inertia")
        mass, color = robot.find("link/inertial/mass"), robot.find("link/visual/material/color")
        assert inertia is not None and mass is not None and color is not None
        assert tuple(float(inertia.get(name, "")) for name in ("ixx", "iyy", "izz")) == record.inertia
        assert float(mass.get("value", "")) == record.mass
        assert tuple(float(word) for word in color.get("rgba", "").split()) == record.color


def test_the_obj_has_one_group_for_each_convex_part(small_set: ObjectSet) -> None:
    for record in small_set.objects:
        lines = (small_set.folder / record.mesh).read_text().splitlines()
        assert sum(line.startswith("o ") for line in lines) == record.parts


def test_parts_of_reads_the_vertices_of_the_obj(small_set: ObjectSet) -> None:
    record = small_set.objects[3]
    lines = (small_set.folder / record.mesh).read_text().splitlines()
    vertices = np.array([[float(word) for word in line.split()[1:]] for line in lines if line.startswith("v ")])
    parts = small_set.parts_of(record.object_id)
    np.testing.assert_array_equal(np.concatenate([part.vertices for part in parts]), vertices)


def test_verify_names_the_first_damaged_or_missing_file(copied: ObjectSet) -> None:
    damaged = copied.folder / copied["train_003"].mesh
    content = bytearray(damaged.read_bytes())
    content[100] ^= 1
    damaged.write_bytes(content)
    with pytest.raises(UserError, match=r"train_003\.obj: damaged"):
        copied.verify()
    (copied.folder / copied["train_001"].urdf).unlink()
    with pytest.raises(UserError, match=r"train_001\.urdf: cannot be read"):
        copied.verify()


def test_a_copy_is_identical_and_copying_again_keeps_it(small_set: ObjectSet, tmp_path: Path) -> None:
    copy = small_set.copy_to(tmp_path / "dataset" / "objects")
    assert copy.digest() == small_set.digest()
    assert copy.objects == small_set.objects
    before = {path: path.stat().st_mtime_ns for path in copy.folder.rglob("*")}
    small_set.copy_to(tmp_path / "dataset" / "objects")
    assert {path: path.stat().st_mtime_ns for path in copy.folder.rglob("*")} == before
    assert [path.name for path in (tmp_path / "dataset").iterdir()] == ["objects"]


def test_a_damaged_set_is_not_copied(copied: ObjectSet, tmp_path: Path) -> None:
    (copied.folder / copied.objects[0].urdf).write_text("other")
    with pytest.raises(UserError, match="damaged"):
        copied.copy_to(tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


def test_an_unknown_object_or_split_is_refused_with_what_there_is(small_set: ObjectSet) -> None:
    with pytest.raises(UserError, match="no object 'cup'"):
        small_set["cup"]
    with pytest.raises(UserError, match="choose from train, test, validation"):
        small_set.ids("mirror")


def _first(values: dict[str, object]) -> Callable[[dict[str, Any]], dict[str, Any]]:
    return lambda manifest: manifest | {"objects": [manifest["objects"][0] | values]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda values: values | {"format_version": 99}, "format_version 99, expected 1"),
        (lambda values: {key: value for key, value in values.items() if key != "seed"}, "not a readable object set"),
        (lambda values: values | {"objects": []}, "expected one or more objects"),
        (lambda values: values | {"objects": values["objects"][:1] * 2}, "ids of their own"),
        (lambda values: values | {"objects": [{"object_id": "x"}]}, "not a readable object set"),
        (lambda values: [1, 2], "not a readable object set"),
        (_first({"sha256": {"../../secret": "0"}}), "expected the files meshes/train_000.obj and"),
        (_first({"mesh": "/etc/passwd"}), "expected the files meshes/train_000.obj and"),
        (_first({"object_id": "../x"}), "expected letters, digits"),
        (_first({"split": 3}), "expected words"),
        (_first({"mass": 0}), "expected sizes above 0"),
        (_first({"mass": "heavy"}), "expected finite numbers"),
        (_first({"inertia": [1e-5, float("nan"), 1e-5]}), "expected finite numbers"),
        (_first({"color": [1, 0, 0]}), "expected finite numbers"),
    ],
)
def test_a_manifest_that_is_none_gives_one_clear_error(copied: ObjectSet, change: object, message: str) -> None:
    path = copied.folder / "object_set.json"
    path.write_text(json.dumps(change(json.loads(path.read_text()))))  # type: ignore[operator]
    with pytest.raises(UserError, match=message):
        ObjectSet.load(copied.folder)


def test_a_missing_or_corrupted_manifest_is_a_user_error(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no object set"):
        ObjectSet.load(tmp_path / "nowhere")
    for content in (b'{"format_version": 1, "obj\xff', b"[" * 200_000, b'{"seed": ' + b"9" * 5000 + b"}"):
        (tmp_path / "object_set.json").write_bytes(content)
        with pytest.raises(UserError, match="not a readable object set"):
            ObjectSet.load(tmp_path)


def test_a_manifest_is_compared_with_the_digest_beside_it(copied: ObjectSet) -> None:
    path, beside = copied.folder / "object_set.json", copied.folder / "object_set.json.sha256"
    assert beside.read_text() == f"{copied.digest()}  object_set.json\n"
    edited = path.read_bytes().replace(b'"mass": 0.', b'"mass": 1.', 1)
    path.write_bytes(edited)
    with pytest.raises(UserError, match=r"object_set\.json: damaged or edited"):
        ObjectSet.load(copied.folder)
    beside.unlink()  # a set that an older version made
    assert ObjectSet.load(copied.folder).digest() != copied.digest()


@pytest.mark.parametrize("name", ["object_set.json", "meshes/train_000.obj"])
def test_a_pipe_is_not_waited_for(copied: ObjectSet, name: str) -> None:
    (copied.folder / name).unlink()
    os.mkfifo(copied.folder / name)
    with pytest.raises(UserError, match=r"not a regular file|or a pipe"):
        ObjectSet.load(copied.folder)


@pytest.mark.parametrize("name", ["meshes", "meshes/train_000.obj"])
def test_a_link_to_files_elsewhere_is_refused(copied: ObjectSet, tmp_path: Path, name: str) -> None:
    (copied.folder / name).rename(tmp_path / "elsewhere")
    (copied.folder / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="a link is among them"):
        ObjectSet.load(copied.folder)


def test_a_simulator_is_given_a_urdf_that_says_what_the_record_says(copied: ObjectSet) -> None:
    path = copied.urdf_of("train_000")
    assert path == copied.folder / copied["train_000"].urdf
    other = copied.folder / copied["train_001"].urdf
    other.write_text(other.read_text().replace('filename="train_001.obj"', 'filename="../../secret.obj"'))
    with pytest.raises(UserError, match=r"train_001\.urdf: says something else than object_set\.json"):
        copied.urdf_of("train_001")


@pytest.mark.parametrize(
    "content",
    [
        "", "v 0 0\nf 1 2 3\n", "o a\nv 0 0 0\nf 1 2 9\n", "o a\nv x y z\n", "o a\nv nan 0 0\nf 1 1 1\n",
        "o a\nv 0 0 0\nf 1 1 3000000000\n", "o a\nv 0 0 0\nf 1 1 -1\n", f"o a\nv 0 0 0\nf 1 1 {'9' * 30}\n", "o a\n",
    ],
)  # fmt: skip
def test_an_unreadable_mesh_is_a_user_error(copied: ObjectSet, content: str) -> None:
    (copied.folder / copied["train_000"].mesh).write_text(content)
    for read in (copied.parts_of, copied.urdf_of):
        with pytest.raises(UserError, match=r"train_000\.obj"):
            read("train_000")
