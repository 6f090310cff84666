import os
from pathlib import Path

import pytest

from graspq.common.errors import UserError
from graspq.objects.publishing import MANIFEST, published


def _publish(folder: Path, content: str = "{}") -> None:
    with published(folder, what="object set") as temporary:
        (temporary / MANIFEST).write_text(content)


def test_a_folder_appears_whole_and_nothing_else_is_left(tmp_path: Path) -> None:
    _publish(tmp_path / "deep" / "set")
    assert (tmp_path / "deep" / "set" / MANIFEST).read_text() == "{}"
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["set"]


def test_an_empty_folder_is_filled(tmp_path: Path) -> None:
    (tmp_path / "set").mkdir()
    _publish(tmp_path / "set")
    assert (tmp_path / "set" / MANIFEST).is_file()


def test_after_an_error_or_an_interruption_nothing_is_left(tmp_path: Path) -> None:
    for error in (RuntimeError, KeyboardInterrupt):
        with pytest.raises(error), published(tmp_path / "set", what="object set") as temporary:
            (temporary / "half").write_text("x")
            raise error
    assert not list(tmp_path.iterdir())


def test_other_content_is_never_overwritten(tmp_path: Path) -> None:
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
    def make() -> None:
        with published(tmp_path / "set", what="object set") as temporary:
            (temporary / MANIFEST).write_text("{}")
            (temporary / "mesh").write_text("good")

    make()
    (tmp_path / "set" / "mesh").write_text("bad!")
    with pytest.raises(UserError, match="mesh: damaged"):
        make()
    (tmp_path / "set" / "mesh").unlink()
    with pytest.raises(UserError, match="mesh: missing"):
        make()


def test_what_a_killed_maker_left_is_removed_and_a_living_one_is_not_disturbed(tmp_path: Path) -> None:
    # Process ids end far below this one.
    dead, living = tmp_path / ".tmp-999999999-set", tmp_path / f".tmp-{os.getppid()}-set"
    for folder in (dead, living):
        folder.mkdir()
        (folder / "half").write_text("x")
    _publish(tmp_path / "set")
    assert not dead.exists()
    assert living.exists()
