"""The paper's claims: each verdict has scores that give it."""

from typing import Any

import numpy as np
import pytest

from graspq.evaluate.statistics import SeveralRuns
from graspq.studies.study import claims
from graspq.studies.study.comparisons import Compared, asked_rows, trainings
from tests.studies.study.scored_studies import runs, scenes, study

BEST = {"dql": 0.95, "mc": 0.8, "corr_mc": 0.85, "supervised": 0.85, "ddpg": 0.7, "pcl": 0.5}


def verdict(claim: Any, table: list[dict[str, Any]]) -> str:
    found = trainings(table) if claim is claims.actor_unstable else asked_rows(table)
    return str(claim(found).verdict)


@pytest.mark.parametrize(
    ("changed", "expected"),
    [({}, "holds"), ({"mc": 0.97, "dql": 0.85}, "fails"), ({"mc": 0.95}, "not decided")],
)
def test_dql_is_best_in_low_data_where_it_is_better_than_every_other(changed: dict[str, float], expected: str) -> None:
    assert verdict(claims.dql_best_in_low_data, study(**BEST | changed)) == expected


def test_dql_need_not_beat_supervised_learning_in_low_data() -> None:
    assert verdict(claims.dql_best_in_low_data, study(**BEST | {"supervised": 0.98})) == "holds"


def test_scores_on_validation_decide_no_claim_but_that_of_stability() -> None:
    table = [row | {"split": "validation"} for row in study(**BEST)]
    assert {one.verdict for one in claims.judged(table)} == {"not tested"}


def test_a_row_of_which_a_training_failed_is_not_judged_by_those_that_are_left() -> None:
    table = study(**BEST) + runs("ddpg", 0.0, seeds=1, seed=3, status="failed", reason="diverged")
    for claim in (claims.dql_best_in_low_data, claims.actor_worse, claims.ninety_percent):
        found = claim(asked_rows(table))
        assert (found.verdict, found.seen) == ("not tested", "`ddpg`: 1 of 4 trainings failed")
    assert verdict(claims.supervised_competitive, table) == "not decided"  # it asks nothing of ddpg
    gone = [row | {"status": "failed", "reason": "diverged"} if row.get("row") == "ddpg" else row for row in table]
    assert claims.dql_best_in_low_data(asked_rows(gone)).seen == "`ddpg`: 4 of 4 trainings failed"
    begun = study(**BEST) + runs("mc", 0.0, seeds=1, seed=3, status="to do")
    assert claims.bias_of_mc(asked_rows(begun)).seen == "`mc`: 3 of 4 trainings done"


def test_low_data_are_ten_thousand_grasps() -> None:
    assert verdict(claims.dql_best_in_low_data, [scenes(), *runs("dql", 0.9, size="100k")]) == "not tested"


def test_mc_and_corr_mc_are_judged_at_a_million_on_the_targeted_task_alone() -> None:
    assert verdict(claims.mc_best_at_1m, study(**BEST)) == "not tested"

    def at_1m(**rates: float) -> list[dict[str, Any]]:
        others = {"dql": 0.8, "supervised": 0.8, "ddpg": 0.6, "pcl": 0.5}
        return [row | {"size": "1M", "task": "targeted"} for row in study(**others | rates)]

    assert verdict(claims.mc_best_at_1m, at_1m(mc=0.9, corr_mc=0.92)) == "holds"
    assert verdict(claims.mc_best_at_1m, at_1m(mc=0.7, corr_mc=0.92)) == "fails"


@pytest.mark.parametrize(("mc", "expected"), [(0.93, "holds"), (0.6, "fails"), (0.83, "not decided")])
def test_the_bias_of_mc_is_disastrous_where_it_costs_a_tenth(mc: float, expected: str) -> None:
    assert verdict(claims.bias_of_mc, study(**BEST | {"mc": mc})) == expected


def test_the_discounted_returns_of_mc_are_judged_too_where_they_were_run() -> None:
    table = study(**BEST | {"mc": 0.93}) + runs("mc-discount0.9", 0.6, algo="mc")
    assert verdict(claims.bias_of_mc, table) == "fails"


@pytest.mark.parametrize(("rate", "expected"), [(0.95, "holds"), (0.7, "fails")])
def test_supervised_is_competitive_within_a_margin(rate: float, expected: str) -> None:
    assert verdict(claims.supervised_competitive, study(**BEST | {"supervised": rate})) == expected


def test_on_policy_is_judged_where_a_row_was_scored_both_ways() -> None:
    table = study(8, **BEST)
    assert verdict(claims.on_policy_slight, table) == "not tested"
    assert verdict(claims.on_policy_slight, [*table, *on_policy(**BEST)]) == "holds"
    assert verdict(claims.on_policy_slight, [*table, *on_policy(**BEST | {"dql": 0.7})]) == "fails"
    found = claims.on_policy_slight(asked_rows([*table, *on_policy(dql=0.95)]))
    assert found.verdict == "not tested" and "`pcl`: not run (regular, 10k, on-policy, test)" in found.seen


def on_policy(fresh: int = 3000, **rates: float) -> list[dict[str, Any]]:
    own = {"setting": "on-policy", "fresh_grasps": fresh}
    return [row | own for row in study(8, **rates) if row["kind"] == "run"]


@pytest.mark.parametrize("changed", [{"object_set_sha256": "e" * 64}, {"simulator": "pybullet 4"}])
def test_on_policy_is_not_tested_where_no_row_met_the_same_scenes_both_ways(changed: dict[str, str]) -> None:
    rows = [row | changed for row in on_policy(**BEST)]
    assert verdict(claims.on_policy_slight, [*study(**BEST), *rows]) == "not tested"


def test_on_policy_is_not_tested_where_a_hundredth_of_the_grasps_is_fresh() -> None:
    found = claims.on_policy_slight(asked_rows([*study(**BEST), *on_policy(150, **BEST)]))
    assert (found.verdict, found.seen) == ("not tested", "of the data, 1.5% are fresh grasps")


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
    # The best of more trainings is better: rows are judged with as many.
    more = swept("ddpg", 0.9, 0.4, 0.3, 0.2, 0.1)
    assert verdict(claims.actor_unstable, [scenes(), *steady, *more]) == "not tested"
    two = [*swept("dql", 0.9, 0.88), *swept("dql", 0.9, 0.88), *swept("ddpg", 0.9, 0.4), *swept("ddpg", 0.9, 0.4)]
    assert verdict(claims.actor_unstable, [scenes(), *two]) == "not tested"


@pytest.mark.parametrize(("rate", "expected"), [(0.98, "holds"), (0.8, "fails"), (0.91, "not decided")])
def test_ninety_percent_is_asked_of_the_best_rows_interval_on_test(rate: float, expected: str) -> None:
    lower = {name: min(other, rate - 0.05) for name, other in BEST.items()} | {"dql": rate}
    at_1m = [row | {"size": "1M"} for row in study(**lower)]
    assert verdict(claims.ninety_percent, at_1m) == expected
    assert claims.ninety_percent(asked_rows(at_1m)).seen.startswith("the best of 6: dql (regular, 1M, ")
    on_validation = [row | {"split": "validation"} for row in at_1m]
    assert verdict(claims.ninety_percent, on_validation) == "not tested"


def test_ninety_percent_cannot_fail_with_fewer_grasps_than_the_papers_or_without_all_six() -> None:
    assert verdict(claims.ninety_percent, study(**BEST | {"dql": 0.8})) == "not decided"
    alone = [row | {"size": "1M"} for row in study(dql=0.8)]
    assert verdict(claims.ninety_percent, alone) == "not decided"
    assert verdict(claims.ninety_percent, study(dql=0.98)) == "holds"


def test_ninety_percent_of_the_best_of_many_needs_a_wider_interval() -> None:
    rates = dict.fromkeys(BEST, 0.5)
    for rate in (value / 1000 for value in range(900, 980)):
        alone = asked_rows(study(dql=rate))
        if claims.ninety_percent(alone).verdict == "holds":
            break
    assert verdict(claims.ninety_percent, study(**rates | {"dql": rate})) == "not decided"


@pytest.mark.parametrize("left_out", ["mc", "corr_mc", "ddpg", "pcl"])
def test_a_claim_about_all_others_is_not_judged_without_one_of_them(left_out: str) -> None:
    rates = {name: rate for name, rate in BEST.items() if name != left_out}
    found = claims.dql_best_in_low_data(asked_rows(study(**rates)))
    name = left_out.replace("_", "-")
    assert (found.verdict, found.seen) == ("not tested", f"`{name}`: not run (regular, 10k, off-policy, test)")
    to_do = study(**rates) + runs(name, 0.0, status="to do")
    assert claims.dql_best_in_low_data(asked_rows(to_do)).seen == f"`{name}`: 0 of 3 trainings done"
    assert verdict(claims.actor_worse, study(**rates)) == "not tested"


def test_a_claim_is_not_judged_by_single_trainings() -> None:
    table = study(**BEST | {"mc": 0.0})
    table = [row for row in table if row.get("row") != "mc"] + runs("mc", 0.8, seeds=1)
    for claim in (claims.dql_best_in_low_data, claims.bias_of_mc, claims.actor_worse, claims.ninety_percent):
        found = claim(asked_rows(table))
        assert (found.verdict, found.seen) == ("not tested", "`mc`: one training, which says nothing of another")


def test_one_of_many_differences_fails_a_claim_only_if_its_widened_interval_does() -> None:
    rng = np.random.default_rng(0)

    def interval(low: float, high: float) -> SeveralRuns:
        return SeveralRuns((low + high) / 2, low, high, 0.01, 10.0, 400)

    for _ in range(50):
        middle, half, more = rng.uniform(-0.2, 0.2), rng.uniform(0.01, 0.1), rng.uniform(1, 2)
        one = Compared(
            "a", "b", interval(middle - half, middle + half), interval(middle - more * half, middle + more * half), 0.5
        )
        inside, below = abs(middle) + half < 0.05, middle + more * half < -0.05
        outside = below or middle - more * half > 0.05
        assert claims._slight([one], 0.05) == ("holds" if inside else "fails" if outside else "not decided")
        above = middle - half > -0.05
        assert claims._not_below([one], 0.05) == ("holds" if above else "fails" if below else "not decided")
