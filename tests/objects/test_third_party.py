import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from graspq.common.errors import UserError
from graspq.objects.geometry import half_spaces, union_mass_properties
from graspq.objects.third_party import import_meshes, split_of

BOX = (0.03, 0.05, 0.08)


def _l_shape() -> trimesh.Trimesh:
    """An L of 6 × 6 × 2 cm with arms 2 cm thick, as one closed non-convex surface."""
    outline = [(0, 0), (0.06, 0), (0.06, 0.02), (0.02, 0.02), (0.02, 0.06), (0, 0.06)]
    vertices = [[x, y, z] for z in (0.0, 0.02) for x, y in outline]
    caps = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
    faces = [(a, c, b) for a, b, c in caps] + [(a + 6, b + 6, c + 6) for a, b, c in caps]
    for i in range(6):
        j = (i + 1) % 6
        faces += [(i, j, j + 6), (i, j + 6, i + 6)]
    mesh = trimesh.Trimesh(vertices, faces)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(0.06 * 0.02 * 0.02 + 0.04 * 0.02 * 0.02)
    return mesh


def _urdf(mesh: str, scale: str = "1 1 1", extra: str = "") -> str:
    return f"""<robot name="x"><link name="x">
      <inertial><mass value="0.1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="0"/></inertial>
      <visual><geometry><mesh filename="{mesh}" scale="{scale}"/></geometry>
        <material name="m"><color rgba="0.04 0.07 0.91 1"/></material></visual>
      <collision><origin xyz="0 0 0" rpy="0 0 0"/><geometry><mesh filename="{mesh}" scale="{scale}"/></geometry>
      </collision></link>{extra}</robot>"""


@pytest.fixture
def source(tmp_path: Path) -> Path:
    folder = tmp_path / "meshes"
    folder.mkdir()
    return folder


def test_a_convex_mesh_is_kept_as_one_part_with_the_mass_of_its_density(source: Path, tmp_path: Path) -> None:
    for suffix in ("obj", "stl"):
        trimesh.creation.box(BOX).export(source / f"box {suffix}.{suffix}")
    made = import_meshes(source, tmp_path / "set", density=500)
    assert made.ids() == ("box_obj", "box_stl")
    for record in made.objects:
        assert record.parts == 1
        assert record.families == ("convex",)
        assert sorted(record.extents) == pytest.approx(sorted(BOX), abs=1e-6)
        assert record.mass == pytest.approx(500 * np.prod(BOX), rel=1e-5)
        assert sum(record.inertia) == pytest.approx(record.mass / 6 * np.square(BOX).sum(), rel=1e-5)
    made.verify()


def test_an_l_shape_is_decomposed_into_convex_parts_that_leave_its_corner_open(source: Path, tmp_path: Path) -> None:
    mesh = _l_shape()
    mesh.export(source / "corner.stl")
    made = import_meshes(source, tmp_path / "set")
    record = made["corner"]
    parts = made.parts_of("corner")
    assert record.families == ("decomposed",)
    assert len(parts) >= 2
    assert union_mass_properties(parts).volume == pytest.approx(mesh.volume, rel=0.05)
    assert record.volume < 0.75 * mesh.convex_hull.volume
    for part in parts:
        planes = half_spaces(part)
        assert (planes[:, :3] @ part.vertices.T + planes[:, 3:]).max() < 1e-9
    again = import_meshes(source, tmp_path / "again")
    assert again.digest() == made.digest()


def test_loose_convex_pieces_of_one_file_stay_what_they_are(source: Path, tmp_path: Path) -> None:
    bars = [trimesh.creation.box((0.08, 0.02, 0.02)), trimesh.creation.box((0.02, 0.08, 0.02))]
    trimesh.util.concatenate(bars).export(source / "cross.stl")
    record = import_meshes(source, tmp_path / "set", density=1000)["cross"]
    assert record.parts == 2
    assert record.volume == pytest.approx(2 * 0.08 * 0.02**2 - 0.02**3, rel=1e-5)


def test_groups_of_an_obj_that_share_corners_stay_apart(source: Path, tmp_path: Path) -> None:
    lines, first = [], 1
    for name, centre in (("a", 0.0), ("b", 0.02)):
        cube = trimesh.creation.box((0.02, 0.02, 0.02))
        lines += [f"o {name}", *(f"v {x + centre} {y} {z}" for x, y, z in cube.vertices)]
        lines += ["f " + " ".join(str(index + first) for index in face) for face in cube.faces]
        first += len(cube.vertices)
    (source / "pair.obj").write_text("\n".join(lines))
    record = import_meshes(source, tmp_path / "set")["pair"]
    assert (record.parts, record.families) == (2, ("convex",))


def test_the_layout_of_random_urdfs_is_read_with_scale_mass_and_colour(source: Path, tmp_path: Path) -> None:
    for name in ("000", "001", "010"):
        (source / name).mkdir()
        trimesh.creation.box((2, 4, 6)).export(source / name / f"{name}.obj")
        (source / name / f"{name}.urdf").write_text(_urdf(f"{name}.obj", "0.015 0.015 0.015"))
    made = import_meshes(source, tmp_path / "set")
    assert made.ids("test") == ("000", "010")
    assert made.ids("train") == ("001",)
    record = made["001"]
    assert sorted(record.extents) == pytest.approx([0.03, 0.06, 0.09])
    assert record.mass == 0.1
    assert record.color == (0.04, 0.07, 0.91, 1.0)
    # The file's inertia of 1 kg m² is a placeholder; the shape's is taken.
    assert max(record.inertia) == pytest.approx(0.1 / 12 * (0.06**2 + 0.09**2), rel=1e-5)
    denser = import_meshes(source, tmp_path / "denser", density=1000)
    assert denser["001"].mass == pytest.approx(1000 * record.volume, rel=1e-6)


def test_objects_of_pybullet_data_are_imported_and_the_empty_one_is_left_out(source: Path, tmp_path: Path) -> None:
    data = pytest.importorskip("pybullet_data")
    for name in ("167", "168", "170"):
        shutil.copytree(Path(data.getDataPath()) / "random_urdfs" / name, source / name)
    lines: list[str] = []
    made = import_meshes(source, tmp_path / "set", left_out=lines.append)
    assert {name: made[name].split for name in made.ids()} == {"167": "train", "170": "test"}
    assert [line.split("/")[-1][:7] for line in lines] == ["168.obj"]


def test_the_origin_and_turn_of_a_urdf_shape_place_its_mesh(source: Path, tmp_path: Path) -> None:
    trimesh.creation.box((0.02, 0.02, 0.06)).export(source / "bar.stl")
    origin = '<origin xyz="0.05 0 0" rpy="0 1.5707963267948966 0"/>'
    shape = '<collision>{}<geometry><mesh filename="package://meshes/bar.stl"/></geometry></collision>'
    text = f'<robot name="t"><link name="t">{shape.format("")}{shape.format(origin)}</link></robot>'
    (source / "t.urdf").write_text(text)
    made = import_meshes(source, tmp_path / "set")
    # An upright bar of 6 cm and one that lies along x from 0.02 to 0.08 m.
    assert sorted(made["t"].extents) == pytest.approx([0.02, 0.06, 0.09], abs=1e-6)


def test_numbers_are_split_as_in_the_paper() -> None:
    held_out = [name for name in (f"{index:03d}" for index in range(1000)) if split_of(name) == "test"]
    assert len(held_out) == 100
    assert all(name.endswith("0") for name in held_out)


def test_a_tenth_of_other_names_is_held_out() -> None:
    assert 20 < [split_of(f"cup{index}") for index in range(400)].count("test") < 60


def test_an_object_that_is_added_moves_no_other(source: Path, tmp_path: Path) -> None:
    for name in ("cup2", "170"):
        trimesh.creation.box(BOX).export(source / f"{name}.stl")
    before = import_meshes(source, tmp_path / "few")
    for name in ("1", "a", "cup30", "cup4"):
        trimesh.creation.box(BOX).export(source / f"{name}.stl")
    after = import_meshes(source, tmp_path / "more")
    assert {name: after[name].split for name in before.ids()} == {name: before[name].split for name in before.ids()}
    assert before["170"].split == "test"


def test_a_whole_set_can_be_put_in_one_split(source: Path, tmp_path: Path) -> None:
    trimesh.creation.box(BOX).export(source / "cup.stl")
    assert set(import_meshes(source, tmp_path / "set", split="test").splits) == {"test"}


def test_a_mesh_of_three_metres_is_refused_and_the_advised_scale_works(source: Path, tmp_path: Path) -> None:
    trimesh.creation.box((3, 1, 1)).export(source / "wardrobe.stl")
    with pytest.raises(
        UserError, match=r"wardrobe\.stl: longest side 3 m, expected 0\.01 to 0\.3 m; try --scale 0\.01"
    ):
        import_meshes(source, tmp_path / "set")
    assert not (tmp_path / "set").exists()
    assert max(import_meshes(source, tmp_path / "set", scale=0.01)["wardrobe"].extents) == pytest.approx(0.03)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty.obj", "", "empty mesh"),
        ("empty.stl", "solid x\nendsolid x\n", "empty.stl"),
        ("points.obj", "v 0 0 0\nv 1 0 0\n", "empty mesh"),
        ("nan.obj", "v nan 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n", "nan.obj"),
        ("flat.obj", "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 3\n", "flat mesh"),
        ("cut.stl", "\x00" * 80 + "\x05\x00\x00\x00" + "\x01" * 60, "cut.stl"),
        ("noise.stl", "\x00\x01garbage" * 20, "noise.stl"),
        ("index.obj", "v 0 0 0\nv 0.1 0 0\nf 1 2 9\n", "index.obj"),
        ("broken.urdf", "<robot><link>", "not a readable URDF"),
        ("none.urdf", "<robot/>", "expected one rigid body, found 0"),
        ("lost.urdf", _urdf("lost.obj"), "names the mesh 'lost.obj', which is not in"),
        ("away.urdf", _urdf("../secret.obj"), "names the mesh '../secret.obj', which is not in"),
        ("scale.urdf", _urdf("scale.urdf", "0 1 1"), "expected three numbers above 0"),
        ("scale.urdf", _urdf("scale.urdf", "one"), "not a readable URDF"),
        ("arm.urdf", _urdf("a.obj", extra="<link name='y'><visual/></link>"), "found 2 links"),
    ],
)
def test_an_unusable_file_is_one_line_that_names_it_and_leaves_nothing(
    source: Path, tmp_path: Path, name: str, content: str, message: str
) -> None:
    (source / name).write_text(content)
    trimesh.creation.box(BOX).export(tmp_path / "secret.obj")
    with pytest.raises(UserError, match=message) as refused:
        import_meshes(source, tmp_path / "set")
    assert name in refused.value.message
    assert "\n" not in refused.value.message
    assert sorted(path.name for path in tmp_path.iterdir()) == ["meshes", "secret.obj"]


def test_unusable_objects_are_left_out_with_a_line_each(source: Path, tmp_path: Path) -> None:
    trimesh.creation.box(BOX).export(source / "good.stl")
    (source / "bad.obj").write_text("")
    lines: list[str] = []
    made = import_meshes(source, tmp_path / "set", left_out=lines.append)
    assert made.ids() == ("good",)
    assert len(lines) == 1
    assert "left out" in lines[0] and "bad.obj" in lines[0]


def test_where_none_can_be_used_the_first_is_named(source: Path, tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        trimesh.creation.box((30, 40, 50)).export(source / f"{name}.stl")
    with pytest.raises(UserError, match=r"a\.stl: longest side 50 m.*--scale 0\.001 \(and 2 others cannot be used"):
        import_meshes(source, tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_missing_and_empty_folders_and_odd_numbers_are_refused(source: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such folder"):
        import_meshes(tmp_path / "nowhere", tmp_path / "set")
    with pytest.raises(UserError, match="no OBJ, STL or URDF files"):
        import_meshes(source, tmp_path / "set")
    for scale in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(UserError, match="--scale"):
            import_meshes(source, tmp_path / "set", scale=scale)
        with pytest.raises(UserError, match="--density"):
            import_meshes(source, tmp_path / "set", density=scale)


def test_files_of_the_same_name_in_two_folders_get_ids_of_their_own(source: Path, tmp_path: Path) -> None:
    for folder in ("red", "blue"):
        (source / folder).mkdir()
        trimesh.creation.box(BOX).export(source / folder / "cup.stl")
    assert import_meshes(source, tmp_path / "set").ids() == ("blue-cup", "red-cup")
