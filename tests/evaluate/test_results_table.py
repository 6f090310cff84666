"""The table of results: outcomes as digits and back, and what is no table."""

import json
from pathlib import Path

import numpy as np
import pytest

from graspq.common.errors import UserError
from graspq.evaluate.results_table import COLUMNS, outcomes_of, outcomes_text, read_results, write_results


def test_outcomes_are_a_bit_each_the_first_the_highest() -> None:
    assert outcomes_text([True, False, True, True, False, False, False, True, True]) == "b180"
    assert outcomes_text([]) == ""


@pytest.mark.parametrize("episodes", [1, 7, 8, 9, 1000])
def test_outcomes_come_back_as_they_were(episodes: int) -> None:
    success = np.random.default_rng(episodes).random(episodes) < 0.8
    row = {"outcomes": outcomes_text(success), "episodes": episodes, "successes": int(success.sum())}
    assert len(row["outcomes"]) <= 2 * (episodes + 7) // 8 + 1
    assert np.array_equal(outcomes_of(row), success)


@pytest.mark.parametrize("change", [{"episodes": 17}, {"episodes": 8}, {"successes": 3}, {"outcomes": "b1"}])
def test_outcomes_that_do_not_fit_their_row_are_refused(change: dict[str, object]) -> None:
    row = {"label": "mc", "outcomes": "b180", "episodes": 9, "successes": 5}
    assert outcomes_of(row).sum() == 5
    with pytest.raises(UserError, match="mc: its outcomes are not those of"):
        outcomes_of(row | change)


def test_a_table_is_read_as_written_and_another_file_is_refused_in_one_line(tmp_path: Path) -> None:
    write_results(tmp_path, [{"label": "mc", "success_rate": 0.5}])
    (row,) = read_results(tmp_path / "results.jsonl")
    assert tuple(row) == COLUMNS and (row["label"], row["success_rate"], row["error"]) == ("mc", 0.5, None)
    assert (tmp_path / "results.csv").read_text().splitlines()[0] == ",".join(COLUMNS)
    (tmp_path / "old.jsonl").write_text(json.dumps({"label": "mc"}))
    (tmp_path / "none.jsonl").write_text("{")
    for name, said in (("old", "'policy' is missing"), ("none", "not a readable table"), ("absent", "not a readable")):
        with pytest.raises(UserError, match=said):
            read_results(tmp_path / f"{name}.jsonl")
