"""The command that runs all benchmarks, and the table of ratios that it writes."""

import json
from pathlib import Path

import bench
import pytest
from click.testing import CliRunner
from ratios import RATIOS, ratio_rows, row_where

from graspq.common.errors import UserError

FOUND = {
    "decision": {
        "rows": [
            {"batch": 1, "decision": "cem, trunk once", "times of trunk once": 1.0},
            {"batch": 1, "decision": "cem, 64 tiled copies", "times of trunk once": 30.0},
        ]
    },
    "time_to_quality": {"the paper's time over ours, median": "at least 20"},
    "estimators": {
        "rows": [{"estimator": "dql", "times mc": 0.6}, {"estimator": "corr-mc", "times mc": 0.39}],
    },
}


def test_the_table_has_a_line_for_each_ratio_that_was_measured_and_says_what_missed_its_bar() -> None:
    rows = ratio_rows(FOUND, dict.fromkeys(bench.PARTS, "python benchmarks/x.py"))
    assert len(rows) == len(RATIOS)
    assert {row["met"] for row in rows if row["measured"] == "not measured"} == {""}
    assert [(row["measured"], row["bar"], row["met"]) for row in rows if row["measured"] != "not measured"] == [
        (0.6, "≥ 0.5", "yes"),
        (0.39, "≥ 0.4", "**no**"),
        (30.0, "≥ 4", "yes"),
        ("at least 20", "≥ 5", "yes"),
    ]


def test_shares_are_shown_in_percent_and_must_stay_below_their_bar() -> None:
    waiting = [{"estimator": "mc", "share of waiting": 0.051}, {"estimator": "dql", "share of waiting": 0.012}]
    waiting = [row | {"times a step on ready batches": 1.05} for row in waiting]
    loaders = ["graspq, streaming", "graspq, streaming, SHA-256 of all files first"]
    loaders += ["graspq, all in the buffer, first epoch", "LeRobot-style random access"]
    loaders += ["Hugging Face datasets, map-style", "Hugging Face datasets, streaming"]
    found = {
        "rows": [{"loader": name, "times PNG files": 12.0} for name in loaders],
        "waiting for data in training": waiting,
    }
    memory = {"rows": [{"growth": 0.004}]}
    rows = ratio_rows({"loading": found, "streaming_memory": memory}, dict.fromkeys(bench.PARTS, "c"))
    shares = [(row["measured"], row["met"]) for row in rows if "%" in str(row["measured"])]
    assert shares == [("5.1%", "**no**"), ("1.2%", "yes"), ("0.4%", "yes")]


def test_every_ratio_belongs_to_a_part_and_every_part_is_a_script() -> None:
    assert {ratio.part for ratio in RATIOS} <= set(bench.PARTS)
    for part in bench.PARTS.values():
        words = part.words(shards="s", run="r", own="w")
        assert (Path(bench.FOLDER).parent / words[0]).is_file() and not any("{" in word for word in words)


def test_a_row_that_is_not_there_is_one_clear_line() -> None:
    with pytest.raises(UserError, match="again"):
        row_where(FOUND["decision"]["rows"], batch=32)


def test_a_finished_part_is_not_run_again_and_a_failed_one_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page, out, work = tmp_path / "page.md", tmp_path / "bench.json", tmp_path / "work"
    page.write_text(f"before\n{bench.BEGIN}\nold\n{bench.END}\nafter\n")
    work.mkdir()
    (work / "decision.json").write_text(json.dumps(FOUND["decision"]))
    (work / "decision").mkdir()
    (work / "decision" / "half").touch()
    given = ["--work", str(work), "--out", str(out), "--page", str(page)]
    done = CliRunner().invoke(bench.main, [*given, "--part", "decision"])
    assert done.exit_code == 0, done.output
    assert json.loads(out.read_text())["parts"] == {"decision": FOUND["decision"]}
    text = page.read_text()
    assert text.startswith("before\n") and text.endswith("\nafter\n") and "old" not in text and "| 30 |" in text
    # Measured again, by a command that fails: what was measured before stays, but nothing that it would go on from.
    monkeypatch.setitem(bench.PARTS, "decision", bench.Part("decision", ("--turns", "0")))
    failed = CliRunner().invoke(bench.main, [*given, "--part", "decision", "--again", "decision"])
    assert failed.exit_code == 2
    assert [path.name for path in work.iterdir()] == ["decision.json"]
    assert page.read_text() == text


def test_a_page_without_marks_is_refused() -> None:
    with pytest.raises(UserError, match="lacks"):
        bench.with_section("no marks", "| a |")
