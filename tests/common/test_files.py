import pytest

from graspq.common.errors import UserError
from graspq.common.files import (
    committed,
    read_json,
    remove_temporaries,
    sha256_of,
    writable_folder,
    write_json,
)


def test_a_file_appears_whole_or_not_at_all(tmp_path):
    path = tmp_path / "new" / "file.txt"
    with committed(path) as temporary:
        temporary.write_text("all of it")
        assert not path.exists()
    assert path.read_text() == "all of it"
    with pytest.raises(RuntimeError, match="midway"), committed(path) as temporary:
        temporary.write_text("part")
        raise RuntimeError("midway")
    assert path.read_text() == "all of it"
    assert [entry.name for entry in path.parent.iterdir()] == ["file.txt"]


def test_what_does_not_verify_is_not_committed(tmp_path):
    def refuse(temporary):
        raise OSError("not what was written")

    with pytest.raises(OSError, match="not what was written"), committed(tmp_path / "file", refuse) as temporary:
        temporary.write_bytes(b"x")
    assert not list(tmp_path.iterdir())


def test_json_is_read_back_and_bad_json_is_the_users_mistake(tmp_path):
    write_json(tmp_path / "a.json", {"key": [1, 2.5, "é"]})
    assert read_json(tmp_path / "a.json", "manifest") == {"key": [1, 2.5, "é"]}
    (tmp_path / "b.json").write_text("{")
    with pytest.raises(UserError, match="not a readable manifest"):
        read_json(tmp_path / "b.json", "manifest")
    with pytest.raises(UserError, match="no manifest here"):
        read_json(tmp_path / "c.json", "manifest")


def test_only_our_own_temporaries_are_removed(tmp_path):
    (tmp_path / ".tmp-1-shard").touch()
    (tmp_path / "notes.tmp").touch()
    remove_temporaries(tmp_path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["notes.tmp"]


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot write the dataset here"):
        writable_folder(tmp_path / "file" / "folder", "dataset")


def test_the_digest_is_that_of_the_bytes(tmp_path):
    (tmp_path / "file").write_bytes(b"abc")
    assert sha256_of(tmp_path / "file").startswith("ba7816bf8f01cfea")
