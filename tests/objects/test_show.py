from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from graspq.common.errors import UserError
from graspq.objects.drawing import draw, rasterise, standing
from graspq.objects.object_set import ObjectSet
from graspq.objects.shapes import cuboid
from graspq.objects.show import contact_sheet


def test_a_contact_sheet_is_a_png_that_shows_the_asked_objects(small_set: ObjectSet, tmp_path: Path) -> None:
    out = tmp_path / "sheets" / "test.png"
    assert contact_sheet(small_set, out, split="test", count=5) == 5
    picture = matplotlib.image.imread(out)
    assert picture.shape[0] > 300
    assert picture.shape[1] > 300
    saturation = np.ptp(picture[..., :3], axis=-1)
    assert (saturation > 0.3).mean() > 0.02
    assert contact_sheet(small_set, tmp_path / "all.png", split="test") == 8
    assert [path.name for path in out.parent.iterdir()] == ["test.png"]


def test_the_same_set_gives_the_same_picture(small_set: ObjectSet, tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        contact_sheet(small_set, tmp_path / name, count=2)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_an_object_is_drawn_in_its_colour_on_a_light_floor_with_a_shadow() -> None:
    up = np.array([0.0, 0.0, 1.0])
    picture = draw(standing([cuboid((0.05, 0.05, 0.05))], up), (1.0, 0.0, 0.0), 64, 0.15).astype(int)
    red = picture[..., 0] - picture[..., 1]
    assert red[32, 32] > 100
    assert (red > 60).mean() == pytest.approx(0.05**2 * 1.6 / 0.15**2, rel=0.35)
    assert picture[0, 0].min() > 240
    grey = (np.ptp(picture, axis=-1) < 8) & (picture[..., 0] < 225)
    assert grey.sum() > 20


def test_an_object_stands_on_the_floor() -> None:
    triangles = standing([cuboid((0.05, 0.03, 0.08), (1.0, 2.0, 3.0))], np.array([1.0, 0.0, 0.0]))
    assert triangles[..., 2].min() == pytest.approx(0)
    assert triangles[..., 2].max() == pytest.approx(0.05)


def test_the_nearer_of_two_triangles_is_seen() -> None:
    far = np.array([[0.0, 0.0, 0.0], [8.0, 0.0, 0.0], [0.0, 8.0, 0.0]])
    near = far + np.array([0.0, 0.0, 1.0])
    face, depth = rasterise(np.stack([near, far]), 8)
    assert face[1, 1] == 0
    assert depth[1, 1] == 1.0
    assert face[7, 7] == -1


def test_a_wrong_ending_an_unknown_split_and_an_unwritable_place_are_refused(
    small_set: ObjectSet, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=r"\.png"):
        contact_sheet(small_set, tmp_path / "sheet.jpg")
    with pytest.raises(UserError, match="no split 'validation'"):
        contact_sheet(small_set, tmp_path / "sheet.png", split="validation")
    (tmp_path / "file").write_text("x")
    with pytest.raises(UserError, match="cannot write the picture"):
        contact_sheet(small_set, tmp_path / "file" / "sheet.png", count=1)
