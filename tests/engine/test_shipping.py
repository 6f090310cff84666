import os
import time

import pytest

from graspq.common.files import cache_folder
from graspq.engine.shipping import digest_of, packed, received, unpack, unpack_parts


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def make(folder):
    (folder / "deep").mkdir(parents=True)
    (folder / "deep" / "a.bin").write_bytes(b"\0\1")
    (folder / "b.txt").write_text("b")
    return folder


def test_the_same_files_give_the_same_bytes_whenever_they_were_made(tmp_path):
    first, second = make(tmp_path / "one"), make(tmp_path / "two")
    os.utime(second / "b.txt", (1, 1))
    (second / "b.txt").chmod(0o600)
    assert packed(first) == packed(second)
    (second / "b.txt").write_text("c")
    assert digest_of(packed(first)) != digest_of(packed(second))


def test_a_folder_comes_out_as_it_went_in_but_for_links(tmp_path):
    folder = make(tmp_path / "one")
    (folder / "link").symlink_to("/etc/passwd")
    unpack(packed(folder), tmp_path / "out")
    found = {str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*")}
    assert found == {"deep", "deep/a.bin", "b.txt"} and (tmp_path / "out/deep/a.bin").read_bytes() == b"\0\1"


def test_parts_of_a_folder_take_the_place_of_older_ones_and_nothing_else_is_touched(tmp_path):
    here, there = make(tmp_path / "one"), make(tmp_path / "two")
    (there / "deep/a.bin").unlink()
    (there / "deep/new").write_text("n")
    (there / "c.txt").write_text("c")
    content = packed(there, [there / "deep", there / "c.txt", there / "absent"])
    unpack_parts(content, here, [here / "deep", here / "c.txt", here / "absent"])
    found = {str(path.relative_to(here)) for path in here.rglob("*")}
    assert found == {"deep", "deep/new", "b.txt", "c.txt"}


def test_what_has_been_received_is_not_fetched_again_and_goes_when_nobody_uses_it(tmp_path):
    content, fetched = packed(make(tmp_path / "one")), []

    def fetch():
        fetched.append(True)
        return content

    places = {received(digest_of(content), fetch) for _ in range(2)}
    assert places == {cache_folder("shipped", digest_of(content))} and len(fetched) == 1
    (old := cache_folder("shipped", "old")).mkdir()
    os.utime(old, (time.time() - 30 * 24 * 3600,) * 2)
    received("another", fetch)
    assert not old.exists() and len(list(cache_folder("shipped").iterdir())) == 2
