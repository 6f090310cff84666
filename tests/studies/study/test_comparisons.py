"""Rows against each other on the same scenes."""

from typing import Any

import pytest

from graspq.common.errors import UserError
from graspq.studies.study.comparisons import Place, against, scored_rows
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
