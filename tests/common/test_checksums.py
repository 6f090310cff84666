import json
from pathlib import Path

import pytest

from graspq.common.checksums import (
    DamagedError,
    checked,
    checked_lines,
    read_checked_json,
    read_checked_lines,
    with_checksum,
    write_checked_json,
)
from graspq.common.errors import UserError

VALUE = {"name": "é", "rate": 0.5, "nested": {"checksum": "", "list": [1, None, "\u2028"]}}
ROWS = [{"step": 50, "loss": 0.25}, {"step": 100, "loss": 0.125, "note": "a\nb"}]


def flips(content: bytes) -> list[bytes]:
    return [
        content[:place] + bytes([content[place] ^ 1 << bit]) + content[place + 1 :]
        for place in range(len(content))
        for bit in range(8)
    ]


def test_the_same_object_gives_the_same_text_and_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_checked_json(path, VALUE)
    assert read_checked_json(path, "thing", "") == VALUE
    assert path.read_text() == with_checksum(VALUE, indent=2)
    assert list(json.loads(path.read_text())) == [*VALUE, "checksum"]


def test_no_flipped_bit_of_a_file_changes_what_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_checked_json(path, VALUE)
    detected = 0
    for flipped in flips(path.read_bytes()):
        path.write_bytes(flipped)
        try:
            found = read_checked_json(path, "thing", "copy it again")
        except DamagedError as error:
            assert str(path) in error.message and "copy it again" in error.message
            detected += 1
        else:
            # In the name of the entry itself: the file is then taken for one of an older version, and is whole.
            assert {name: found[name] for name in VALUE} == VALUE
    assert detected >= len(flips(path.read_bytes())) - 8 * len("checksum")


def test_no_flipped_bit_of_a_line_changes_what_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    for grows in (False, True):
        for flipped in flips(checked_lines(ROWS).encode()):
            path.write_bytes(flipped)
            with pytest.raises(DamagedError, match=r"line [12]"):
                print(read_checked_lines(path, "rows", "", grows=grows), flipped)


def test_a_growing_file_loses_only_the_line_that_a_crash_cut_short(tmp_path: Path) -> None:
    path, whole = tmp_path / "a.jsonl", checked_lines(ROWS).encode()
    first = whole.index(b"\n") + 1
    for end in range(len(whole) + 1):
        path.write_bytes(whole[:end])
        expected = ROWS[: (end >= first - 1) + (end >= len(whole) - 1)]
        assert read_checked_lines(path, "rows", "", grows=True) == expected
    path.write_bytes(whole[: first + 10])
    with pytest.raises(DamagedError):
        read_checked_lines(path, "rows", "")
    path.write_bytes(whole + b"\0" * 40)  # what a power cut leaves where a line was to come
    assert read_checked_lines(path, "rows", "", grows=True) == ROWS


def test_what_older_versions_wrote_is_read_unchecked(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps(VALUE))
    assert read_checked_json(path, "thing", "") == VALUE
    path.write_text("".join(json.dumps(row) + "\n" for row in ROWS))
    assert read_checked_lines(path, "rows", "") == ROWS
    path.write_text(json.dumps(ROWS[0]) + "\n" + with_checksum(ROWS[1]))
    with pytest.raises(DamagedError, match=r"line 2.*some have none"):
        read_checked_lines(path, "rows", "")


@pytest.mark.parametrize("text", ["", "[" * 100_000, "9" * 5_000, "[1]", '{"checksum": 5}', '{"a": "checksum"', "\xff"])
def test_what_is_no_such_file_gives_one_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(DamagedError, match=r"a\.json: damaged") as caught:
        read_checked_json(path, "thing", "")
    assert "\n" not in caught.value.message
    path.unlink()
    with pytest.raises(UserError, match="no thing here"):
        read_checked_json(path, "thing", "")


def test_numbers_that_are_not_finite_and_an_entry_of_the_same_name_are_no_files() -> None:
    with pytest.raises(ValueError, match="JSON"):
        with_checksum({"loss": float("nan")})
    with pytest.raises(ValueError, match="no entry"):
        with_checksum({"checksum": "1"})
    assert checked(b'{"a": 1}') == ({"a": 1}, False)
