"""Rows against each other on the same scenes."""

from typing import Any

import pytest

from graspq.common.errors import UserError
from graspq.studies.study.comparisons import Place, against, asked_rows, reference_row, scored_rows
from tests.studies.study.scored_studies import runs, study

PLACE = Place("regular", "10k", "off-policy", "test")


def test_rows_stand_at_their_place_with_their_runs_and_failures() -> None:
    table = study(dql=0.9)
    table += runs("dql", 0.9, seeds=1, seed=3, status="failed", reason="diverged")
    table += runs("mc", 0.5, seeds=1, status="to do")
    table += runs("mc", 0.5, seeds=2, size="1k")
    found = scored_rows(table)
    assert {place.size: set(rows) for place, rows in found.items()} == {"10k": {"dql"}, "1k": {"mc"}}
    row = found[PLACE]["dql"]
    assert (len(row.rows), row.asked, row.failures) == (3, 4, ("seed 3: diverged",))
    assert row.success.shape == (3, 400) and row.counts is not None and row.counts.shape == (400, 40)
    assert row.mean.value == pytest.approx(sum(row.rates) / 3)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (
            {"seed": 3, "recipe_sha256": "e" * 64, "study": "t"},
            r"2 recipes \(c{8} of study s, e{8} of study t\)",
        ),
        ({"seed": 3, "data_sha256": "e" * 64}, "2 datasets"),
        ({"seed": 1}, "seed 1 stands there twice"),
        ({"row": "mc", "episodes": 396}, "2 numbers of episodes"),
        ({"row": "mc", "object_set_sha256": "e" * 64}, "2 object sets"),
        ({"row": "mc", "simulator": "pybullet 4"}, "2 simulator versions"),
    ],
)
def test_what_is_not_one_row_on_the_same_scenes_is_refused(changed: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError, match=said) as caught:
        scored_rows(study(dql=0.9) + runs("dql", 0.9, seeds=1, **changed))
    assert "\n" not in caught.value.message


def test_the_others_are_compared_with_the_best_row() -> None:
    found = against(scored_rows(study(dql=0.9, mc=0.7, corr_mc=0.9))[PLACE])
    assert found["mc"].worse and not found["mc"].better
    (other,) = set(found) - {"mc"}
    assert not found[other].worse and found["mc"].second != other
    assert str(found["mc"]).startswith(f"mc − {found['mc'].second}: -0.1")


def test_a_named_row_takes_the_place_of_the_best() -> None:
    found = against(scored_rows(study(dql=0.9, mc=0.7, pcl=0.8))[PLACE], "mc")
    assert {(one.first, one.second, one.better) for one in found.values()} == {("dql", "mc", True), ("pcl", "mc", True)}


def test_p_values_count_all_pairs_where_the_row_to_compare_with_was_picked_by_them() -> None:
    rates = {"dql": 0.9, "mc": 0.87, "pcl": 0.86, "ddpg": 0.5, "nstep": 0.4}
    rows = scored_rows(study(**rates))[PLACE]
    picked, named = against(rows), against(rows, "dql")
    assert {one.second for one in picked.values()} == {"dql"} and picked.keys() == named.keys()
    raw = {name: one.difference.p_value for name, one in named.items()}
    assert [picked[name].difference for name in raw] == [named[name].difference for name in raw]
    assert picked["ddpg"].p_value == pytest.approx(min(10 * raw["ddpg"], 1), rel=10)
    assert all(picked[name].p_value >= named[name].p_value for name in raw)
    assert picked["mc"].p_value > named["mc"].p_value or named["mc"].p_value == 1
    wider = named["mc"].widened
    assert wider.low < named["mc"].difference.low and wider.high > named["mc"].difference.high


def test_the_row_to_compare_with_is_the_best_whose_trainings_are_all_done() -> None:
    table = study(dql=0.8, mc=0.7)
    failed = runs("ddpg", 0.95) + runs("ddpg", 0.0, seeds=1, seed=3, status="failed", reason="diverged")
    begun = runs("pcl", 0.9) + runs("pcl", 0.0, seeds=1, seed=3, status="to do")
    rows = scored_rows(table + failed + begun)[PLACE]
    assert reference_row(rows).name == "dql" and set(against(rows)) == {"mc"}
    assert reference_row(scored_rows(failed + begun)[PLACE]).name == "pcl"
    assert reference_row(rows, "ddpg").name == "ddpg" and against(rows, "ddpg") == {}
    assert (rows["ddpg"].lacking, rows["pcl"].lacking) == ("1 of 4 trainings failed", "3 of 4 trainings done")


def test_rows_that_were_not_begun_are_asked_for_and_not_scored() -> None:
    table = study(dql=0.8) + runs("pcl", 0.0, status="to do")
    assert asked_rows(table)[PLACE]["pcl"].lacking == "0 of 3 trainings done" and "pcl" not in scored_rows(table)[PLACE]
