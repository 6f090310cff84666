"""The benchmark of training speed gives each estimator a row, in real transitions and in times of `mc`."""

import json

import estimators
import pytest
from drawn_data import make_dataset

from graspq.train.estimators import ESTIMATORS

# One that trains on single transitions, one that needs the next picture, one that trains on padded episodes.
MEASURED = ("mc", "dql", "corr-mc")


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    """A hundred drawn episodes of 16 × 16 pixels, the least that the default network takes."""
    folder = tmp_path_factory.mktemp("data") / "drawn"
    make_dataset(folder, blocks=50, per_shard=25, size=16)
    return str(folder)


@pytest.fixture(autouse=True)
def few(monkeypatch):
    monkeypatch.setattr(estimators, "ESTIMATORS", {name: ESTIMATORS[name] for name in MEASURED})


def run(arguments):
    with pytest.raises(SystemExit) as ended:
        estimators.main.main(arguments, prog_name="estimators")
    return ended.value.code


def measured(shards, out, steps):
    assert run(["--shards", shards, "--turns", "1", "--steps", steps, "--threads", "1", "--out", str(out)]) in (0, None)
    return json.loads(out.read_text())


def test_one_turn_of_one_step_gives_a_row_for_each_in_times_of_mc(shards, tmp_path):
    found = measured(shards, tmp_path / "speed.json", "1")
    assert (found["turns"], found["steps a turn"]) == (1, 1)
    rows = {row["estimator"]: row for row in found["rows"]}
    assert tuple(rows) == MEASURED
    assert rows["mc"]["times mc"] == 1.0
    for name, row in rows.items():
        assert row["transitions a second"] > 0
        # In a single turn: the faster, the greater.
        ratio = row["transitions a second"] / rows["mc"]["transitions a second"]
        assert row["times mc"] == pytest.approx(ratio), name


def test_real_transitions_are_counted_and_padding_is_not(shards, tmp_path, monkeypatch):
    def a_second_each(runs, turns):
        for train in runs.values():
            train()
        return {name: [1.0] * turns for name in runs}

    monkeypatch.setattr(estimators, "take_turns", a_second_each)
    pace = {row["estimator"]: row["transitions a second"] for row in measured(shards, tmp_path / "s.json", "2")["rows"]}
    assert pace["mc"] == pace["dql"] == 2 * 256
    # Whole episodes of 1 to 8 steps: about as many transitions, of nearly twice as many places.
    assert pace["corr-mc"] == pytest.approx(2 * 256, rel=0.1)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "--shards"),
        (["--shards", "nowhere"], "nowhere"),
        (["--shards", "nowhere", "--turns", "0"], "--turns"),
        (["--shards", "nowhere", "--steps", "many"], "'many'"),
    ],
)
def test_a_mistake_is_one_line_and_exit_status_2(monkeypatch, capsys, tmp_path, arguments, said):
    monkeypatch.chdir(tmp_path)
    assert run(arguments) == 2
    printed = capsys.readouterr().err
    assert len(printed.splitlines()) == 1
    assert said in printed
