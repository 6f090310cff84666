import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import trimesh

from graspq.objects.object_set import ObjectSet

Run = Callable[..., tuple[int, str, str]]


def test_make_show_and_make_again(grasp_objects: Run, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    arguments = ("make", "procedural", folder, "--seed", "3", "--train", "2", "--test", "1", "--validation", "1")
    status, out, err = grasp_objects(*arguments)
    assert (status, err) == (0, "")
    assert "4 procedural objects (2 train, 1 test, 1 validation), made" in out
    status, out, _ = grasp_objects(*arguments)
    assert status == 0
    assert "already there, identical" in out
    assert grasp_objects("show", folder, "--out", tmp_path / "sheet.png", "--split", "train", "--count", "30")[0] == 0
    assert (tmp_path / "sheet.png").read_bytes().startswith(b"\x89PNG")


def test_make_targeted_and_import(grasp_objects: Run, tmp_path: Path) -> None:
    assert grasp_objects("make", "targeted", tmp_path / "targeted")[0] == 0
    assert len(ObjectSet.load(tmp_path / "targeted")) == 13
    (tmp_path / "meshes").mkdir()
    trimesh.creation.box((30, 40, 50)).export(tmp_path / "meshes" / "box.stl")
    status, _, _ = grasp_objects("make", "import", tmp_path / "meshes", tmp_path / "set", "--scale", "0.001")
    assert status == 0
    assert ObjectSet.load(tmp_path / "set").name == "meshes"


def _bad_inputs(tmp_path: Path) -> dict[str, tuple[tuple[str | Path, ...], str]]:
    for name, mesh in (("wide", trimesh.creation.box((3, 1, 1))), ("good", trimesh.creation.box((0.05, 0.05, 0.05)))):
        (tmp_path / name).mkdir()
        mesh.export(tmp_path / name / f"{name}.stl")
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "empty.obj").write_text("")
    (tmp_path / "corrupted").mkdir()
    (tmp_path / "corrupted" / "noise.stl").write_bytes(b"\x00\xffgarbage" * 30)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("x")
    out = tmp_path / "out"
    picture = tmp_path / "sheet.png"
    return {
        "an empty mesh": (("make", "import", tmp_path / "empty", out), "empty.obj: an empty mesh"),
        "a mesh 3 m wide": (("make", "import", tmp_path / "wide", out), "try --scale 0.01"),
        "a missing folder": (("make", "import", tmp_path / "nowhere", out), "no such folder"),
        "a corrupted file": (("make", "import", tmp_path / "corrupted", out), "noise.stl: "),
        "a folder of other things": (("make", "procedural", tmp_path / "full"), "not empty and no object set"),
        "another set": (("make", "procedural", tmp_path / "set", "--seed", "8"), "holds another object set"),
        "the set in another size": (
            ("make", "procedural", tmp_path / "set", "--seed", "7", "--train", "1", "--test", "1"),
            "holds another object set",
        ),
        "a negative seed": (("make", "procedural", out, "--seed", "-1"), "--seed"),
        "no objects": (("make", "procedural", out, "--train", "0"), "--train"),
        "an unknown family": (
            ("make", "procedural", out, "--held-out-family", "egg"),
            "--held-out-family egg: choose some",
        ),
        "a word for a number": (("make", "procedural", out, "--train", "many"), "many"),
        "a negative scale": (("make", "import", tmp_path / "good", out, "--scale", "-1"), "--scale"),
        "no set to show": (("show", tmp_path / "nowhere", "--out", picture), "no object set"),
        "an unknown split": (("show", tmp_path / "set", "--out", picture, "--split", "x"), "no split 'x'"),
        "no picture": (("show", tmp_path / "set", "--out", tmp_path / "sheet.jpg"), ".png"),
        "an unknown command": (("make", "teapot"), "teapot"),
    }


@pytest.mark.parametrize(
    "mistake",
    [
        "an empty mesh", "a mesh 3 m wide", "a missing folder", "a corrupted file", "a folder of other things",
        "another set", "the set in another size",
        "a negative seed", "no objects", "an unknown family", "a word for a number", "a negative scale",
        "no set to show", "an unknown split", "no picture", "an unknown command",
    ],
)  # fmt: skip
def test_a_mistake_is_one_line_with_status_2_and_leaves_nothing(
    grasp_objects: Run, small_set: ObjectSet, tmp_path: Path, mistake: str
) -> None:
    shutil.copytree(small_set.folder, tmp_path / "set")
    arguments, expected = _bad_inputs(tmp_path)[mistake]
    before = sorted(tmp_path.rglob("*"))
    status, out, err = grasp_objects(*arguments)
    assert status == 2
    assert out == ""
    assert err.count("\n") == 1
    assert expected in err
    assert sorted(tmp_path.rglob("*")) == before


def test_the_installed_command_answers_without_pybullet(tmp_path: Path) -> None:
    command = Path(sys.executable).with_name("grasp-objects")
    done = subprocess.run([command, "--version"], capture_output=True, text=True, cwd=tmp_path, check=True)
    assert done.stdout.startswith("graspq")
    code = (
        "import sys, graspq.objects.cli; sys.exit(any(name.startswith(('pybullet', 'torch')) for name in sys.modules))"
    )
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)


@pytest.mark.parametrize("command", [(), ("make",), ("make", "procedural"), ("make", "targeted"), ("make", "import")])
def test_every_command_has_help(grasp_objects: Run, command: tuple[str, ...]) -> None:
    status, out, _ = grasp_objects(*command, "--help")
    assert status == 0
    assert "Usage" in out
