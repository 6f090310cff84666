"""The paper's claims: each verdict has scores that give it."""

from typing import Any

import pytest

from graspq.studies.study import claims
from graspq.studies.study.comparisons import scored_rows, trainings
from tests.studies.study.scored_studies import runs, scenes, study

BEST = {"dql": 0.95, "mc": 0.8, "corr_mc": 0.85, "supervised": 0.85, "ddpg": 0.7, "pcl": 0.5}


def verdict(claim: Any, table: list[dict[str, Any]]) -> str:
    found = trainings(table) if claim is claims.actor_unstable else scored_rows(table)
    return str(claim(found).verdict)


@pytest.mark.parametrize(
    ("changed", "expected"),
    [({}, "holds"), ({"mc": 0.97, "dql": 0.85}, "fails"), ({"mc": 0.95}, "not decided")],
)
def test_dql_is_best_in_low_data_where_it_is_better_than_every_other(changed: dict[str, float], expected: str) -> None:
    assert verdict(claims.dql_best_in_low_data, study(**BEST | changed)) == expected


def test_low_data_are_ten_thousand_grasps() -> None:
    assert verdict(claims.dql_best_in_low_data, [scenes(), *runs("dql", 0.9, size="100k")]) == "not tested"


def test_mc_and_corr_mc_are_judged_at_a_million_on_the_targeted_task_alone() -> None:
    assert verdict(claims.mc_best_at_1m, study(**BEST)) == "not tested"
    large = {"size": "1M", "task": "targeted"}
    rows = [*runs("mc", 0.9, **large), *runs("corr-mc", 0.92, **large), *runs("dql", 0.8, **large)]
    assert verdict(claims.mc_best_at_1m, [scenes("targeted"), *rows]) == "holds"
    worse = [*runs("mc", 0.7, **large), *runs("corr-mc", 0.92, **large), *runs("dql", 0.8, **large)]
    assert verdict(claims.mc_best_at_1m, [scenes("targeted"), *worse]) == "fails"


@pytest.mark.parametrize(("mc", "expected"), [(0.93, "holds"), (0.6, "fails"), (0.83, "not decided")])
def test_the_bias_of_mc_is_disastrous_where_it_costs_a_tenth(mc: float, expected: str) -> None:
    assert verdict(claims.bias_of_mc, study(**BEST | {"mc": mc})) == expected


@pytest.mark.parametrize(("rate", "expected"), [(0.95, "holds"), (0.7, "fails")])
def test_supervised_is_competitive_within_a_margin(rate: float, expected: str) -> None:
    assert verdict(claims.supervised_competitive, study(**BEST | {"supervised": rate})) == expected


def test_on_policy_is_judged_where_a_row_was_scored_both_ways() -> None:
    table = study(**BEST)
    assert verdict(claims.on_policy_slight, table) == "not tested"
    assert verdict(claims.on_policy_slight, [*table, *runs("dql", 0.95, setting="on-policy")]) == "holds"
    assert verdict(claims.on_policy_slight, [*table, *runs("dql", 0.7, setting="on-policy")]) == "fails"


@pytest.mark.parametrize(("ddpg", "expected"), [(0.7, "holds"), (0.9, "fails")])
def test_actors_are_worse_where_both_are_worse_than_all_that_search(ddpg: float, expected: str) -> None:
    assert verdict(claims.actor_worse, study(**BEST | {"ddpg": ddpg})) == expected


def test_stability_needs_variants_and_counts_a_failure_as_nothing() -> None:
    assert verdict(claims.actor_unstable, study(**BEST)) == "not tested"

    def swept(algo: str, *rates: float) -> list[dict[str, Any]]:
        return [row for rate in rates for row in runs(f"{algo}-lr{rate}", rate, seeds=2, algo=algo)]

    steady = swept("dql", 0.9, 0.88, 0.89, 0.87)
    assert verdict(claims.actor_unstable, [scenes(), *steady, *swept("ddpg", 0.9, 0.4, 0.3, 0.2)]) == "holds"
    shaky = swept("dql", 0.9, 0.4, 0.3, 0.2)
    assert verdict(claims.actor_unstable, [scenes(), *shaky, *swept("ddpg", 0.9, 0.88, 0.89, 0.87)]) == "fails"
    failed = [row | {"status": "failed", "reason": "diverged"} for row in swept("ddpg", 0.5, 0.6, 0.7)]
    assert verdict(claims.actor_unstable, [scenes(), *steady, *swept("ddpg", 0.9), *failed]) == "holds"


@pytest.mark.parametrize(("rate", "expected"), [(0.98, "holds"), (0.8, "fails"), (0.91, "not decided")])
def test_ninety_percent_is_asked_of_the_best_rows_interval_on_test(rate: float, expected: str) -> None:
    assert verdict(claims.ninety_percent, study(dql=rate, mc=0.5)) == expected
    on_validation = [row | {"split": "validation"} for row in study(dql=rate)]
    assert verdict(claims.ninety_percent, on_validation) == "not tested"
