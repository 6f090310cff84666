"""The table: the same rows in every format."""

import csv
from pathlib import Path
from typing import Any

import pytest

from graspq.evaluate.statistics import wilson_interval
from graspq.evaluate.sweep_table import read_sweep_table
from graspq.studies.sweep.table import OUTCOME, as_markdown, line_of, write_tables
from graspq.studies.sweep.trial import State, Trial


@pytest.fixture
def states(trials: list[Trial], write: Any) -> list[State]:
    first, second, third = trials
    first.note_failure(command="grasp-train", exit_status=2, reason="diverged | at step 7")
    write.trained(second, 100, ({"step": 100, "loss": 1.0, "samples_per_second": 3200.0},))
    write.scored(second, 3)
    write.trained(third, 40)
    return [trial.state() for trial in trials]


def test_json_lines_and_csv_hold_the_same_rows(states: list[State], tmp_path: Path) -> None:
    write_tables(tmp_path, states)
    failed, done, todo = read_sweep_table(tmp_path / "sweep.jsonl")
    assert tuple(done) == ("id", "algo", "learning_rate", "width", "discount", "seed", *OUTCOME)
    assert (done["status"], done["steps"], done["success_rate"], done["training_seconds"]) == ("done", 100, 0.3, 1.0)
    assert (done["ci95_low"], done["ci95_high"]) == wilson_interval(3, 10)
    assert (done["algo"], done["learning_rate"], done["discount"], done["seed"]) == ("dql", 0.001, 0.9, 0)
    assert (failed["status"], failed["reason"], failed["success_rate"]) == ("failed", "diverged | at step 7", None)
    assert (todo["status"], todo["steps"], todo["discount"]) == ("to do", 40, None)
    with (tmp_path / "sweep.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row, other in zip(rows, (failed, done, todo), strict=True):
        assert row == {name: "" if value is None else str(value) for name, value in other.items()}


def test_the_markdown_table_leaves_out_what_no_trial_uses_and_puts_failures_last(states: list[State]) -> None:
    head, _, first, second, third = as_markdown(states).splitlines()
    assert head == (
        "| algo | learning rate | width | discount | seed | success | 95 % interval | steps | training | status |"
    )
    assert first == "| `dql` | 0.001 | 32 | 0.9 | 0 | 0.300 | 0.108 to 0.603 | 100 | 1 s | done |"
    assert second == "| `dql` | 0.01 | 32 | 0.9 | 0 |  |  | 0 |  | failed: diverged \\| at step 7 |"
    assert third == "| `mc` | 0.001 | 64 |  | 0 |  |  | 40 |  | to do |"


def test_a_trials_end_is_one_line(states: list[State]) -> None:
    failed, done, todo = map(line_of, states)
    assert failed == "dql-lr0.01-width32-discount0.9-seed0: failed: diverged | at step 7"
    assert done == "dql-lr0.001-width32-discount0.9-seed0: 30.0 % (10.8 to 60.3), 1 s of training"
    assert todo.endswith("stopped; the same command goes on with it")
