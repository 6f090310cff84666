"""Numbers and tables as people read them."""

import csv
from pathlib import Path

import pytest

from graspq.common.text import aligned, bytes_text, counted, duration_text, markdown, read_jsonl, write_csv, write_jsonl


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (999_949, "999.9 kB"), (999_960, "1.0 MB"), (35_190_000, "35.2 MB"),
     (2.5e9, "2.5 GB"), (4e15, "4000.0 TB")],
)  # fmt: skip
def test_bytes_have_the_unit_that_leaves_one_to_three_digits(count: float, text: str) -> None:
    assert bytes_text(count) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.253, "0.25 s"),
        (9.94, "9.9 s"),
        (42.4, "42 s"),
        (99.6, "100 s"),
        (130, "2 min"),
        (5_000, "83 min"),
        (9_000, "2.5 h"),
    ],
)
def test_durations_have_a_fitting_unit(seconds: float, text: str) -> None:
    assert duration_text(seconds) == text


def test_a_count_agrees_with_its_noun() -> None:
    assert [counted(count, "fault") for count in (0, 1, 2000)] == ["0 faults", "1 fault", "2,000 faults"]


def test_columns_stand_under_each_other_without_spaces_at_the_ends() -> None:
    assert aligned([("name", "number"), ("a", "1"), ("longer", "")]) == "name    number\na       1\nlonger"


def test_a_cell_cannot_break_a_markdown_table() -> None:
    assert markdown(("a", "b"), [("x|y", "")]) == "| a | b |\n|---|---|\n| x\\|y |  |\n"


def test_rows_come_back_from_json_lines_and_csv(tmp_path: Path) -> None:
    rows = [{"name": "a, b", "rate": 0.5}, {"name": "c", "rate": None}]
    write_jsonl(tmp_path / "t.jsonl", rows)
    write_csv(tmp_path / "t.csv", ("name", "rate"), rows)
    assert read_jsonl(tmp_path / "t.jsonl", ("name",), "a command", "a table") == rows
    with (tmp_path / "t.csv").open(newline="") as file:
        assert list(csv.DictReader(file)) == [{"name": "a, b", "rate": "0.5"}, {"name": "c", "rate": ""}]
    with pytest.raises(ValueError, match="not in fieldnames"):
        write_csv(tmp_path / "t.csv", ("name",), rows)
