"""How well measures order checkpoints: signs, what is left out, and the correlation within estimators."""

import pytest

from graspq.evaluate.choosing import ScoredCheckpoint, choosing


def checkpoints(algo: str, rates: list[float], **measures: list[float | None]) -> list[ScoredCheckpoint]:
    return [
        ScoredCheckpoint(algo, {name: values[place] for name, values in measures.items()}, rate)
        for place, rate in enumerate(rates)
    ]


def test_a_measure_that_orders_checkpoints_by_success_has_correlation_one_whatever_its_direction() -> None:
    some = checkpoints("mc", [0.2, 0.5, 0.9], opc=[0.1, 0.2, 0.3], loss=[0.9, 0.8, 0.1], soft_opc=[0.3, 0.2, 0.1])
    found = {one.measure: one.correlation for one in choosing(some)}
    assert found == {"loss": pytest.approx(1), "opc": pytest.approx(1), "soft_opc": pytest.approx(-1)}


def test_measures_of_too_few_checkpoints_or_that_never_vary_are_left_out() -> None:
    assert choosing(checkpoints("mc", [0.2, 0.5], opc=[0.1, 0.2])) == []
    some = checkpoints("mc", [0.2, 0.5, 0.9, 0.8], opc=[0.1, None, None, 0.3], loss=[1.0] * 4)
    assert choosing(some) == []


def test_within_one_estimator_a_measure_may_order_well_what_it_orders_badly_over_all() -> None:
    some = checkpoints("mc", [0.7, 0.8, 0.9], soft_opc=[0.01, 0.02, 0.03])
    some += checkpoints("dql", [0.1, 0.2, 0.3], soft_opc=[0.51, 0.52, 0.53]) + checkpoints("pcl", [0.5], soft_opc=[0.2])
    (one,) = choosing(some)
    assert one.checkpoints == 7
    assert one.within == pytest.approx(1) and one.correlation < 0
    assert choosing(checkpoints("mc", [0.7, 0.8], opc=[1, 2]) + checkpoints("dql", [0.9], opc=[3]))[0].within is None
