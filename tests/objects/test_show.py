from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from graspq.common.errors import UserError
from graspq.objects.object_set import ObjectSet
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


def test_a_sheet_by_family_shows_so_many_of_each_side_by_side(small_set: ObjectSet, tmp_path: Path) -> None:
    assert contact_sheet(small_set, tmp_path / "families.png", split="train", by_family=2) == 32
    picture = matplotlib.image.imread(tmp_path / "families.png")
    assert round(picture.shape[1] / 232) % 2 == 0


def test_the_same_set_gives_the_same_picture(small_set: ObjectSet, tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        contact_sheet(small_set, tmp_path / name, count=2)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_wrong_ending_an_unknown_split_and_an_unwritable_place_are_refused(
    small_set: ObjectSet, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=r"\.png"):
        contact_sheet(small_set, tmp_path / "sheet.jpg")
    with pytest.raises(UserError, match="no split 'mirror'"):
        contact_sheet(small_set, tmp_path / "sheet.png", split="mirror")
    (tmp_path / "file").write_text("x")
    with pytest.raises(UserError, match="cannot write the picture"):
        contact_sheet(small_set, tmp_path / "file" / "sheet.png", count=1)
