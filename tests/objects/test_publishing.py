from pathlib import Path

import pytest

from graspq.common.errors import UserError
from graspq.objects.publishing import MANIFEST, published


def _publish(folder: Path, content: str = "{}") -> None:
    with published(folder) as temporary:
        (temporary / MANIFEST).write_text(content)
        (temporary / "mesh").write_text("good")


def test_a_folder_appears_whole_and_publishing_the_same_again_keeps_it(tmp_path: Path) -> None:
    for _ in range(2):
        _publish(tmp_path / "deep" / "set")
        assert (tmp_path / "deep" / "set" / MANIFEST).read_text() == "{}"
        assert [path.name for path in (tmp_path / "deep").iterdir()] == ["set"]


def test_an_empty_folder_is_filled(tmp_path: Path) -> None:
    (tmp_path / "set").mkdir()
    _publish(tmp_path / "set")
    assert (tmp_path / "set" / MANIFEST).is_file()


def test_other_content_is_never_written_over(tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.txt").write_text("years of work")
    with pytest.raises(UserError, match="not empty and no object set"):
        _publish(tmp_path / "thesis")
    _publish(tmp_path / "set")
    with pytest.raises(UserError, match="holds another object set"):
        _publish(tmp_path / "set", '{"other": 1}')
    assert (tmp_path / "set" / MANIFEST).read_text() == "{}"
    (tmp_path / "file").write_text("x")
    with pytest.raises(UserError, match="is not a folder"):
        _publish(tmp_path / "file")
    with pytest.raises(UserError, match="cannot write"):
        _publish(tmp_path / "file" / "set")


def test_a_damaged_set_that_is_there_is_named_rather_than_trusted(tmp_path: Path) -> None:
    _publish(tmp_path / "set")
    (tmp_path / "set" / "mesh").write_text("bad!")
    with pytest.raises(UserError, match="mesh: missing or damaged"):
        _publish(tmp_path / "set")
    (tmp_path / "set" / "mesh").unlink()
    with pytest.raises(UserError, match="mesh: missing or damaged"):
        _publish(tmp_path / "set")
