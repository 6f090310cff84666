"""The benchmark of training speed gives each estimator a row, in real transitions and in times of `mc`."""

import pytest

from graspq.benchmarks import estimators
from graspq.train.estimators import ESTIMATORS

# One that trains on single transitions, one that needs the next picture, one that trains on padded episodes.
MEASURED = ("mc", "dql", "corr-mc")


def test_real_transitions_are_counted_and_padding_is_not(tmp_path, monkeypatch):
    from drawn_data import make_dataset

    # A hundred drawn episodes of 16 × 16 pixels, the least that the default network takes.
    make_dataset(tmp_path / "drawn", blocks=50, per_shard=25, size=16)
    monkeypatch.setattr(estimators, "ESTIMATORS", {name: ESTIMATORS[name] for name in MEASURED})

    def a_second_each(train, count):
        train()
        return lambda turn: 1 / count

    monkeypatch.setattr(estimators, "timed", a_second_each)
    settings = estimators.EstimatorsSettings(shards=(str(tmp_path / "drawn"),), turns=1, steps=2)
    result = estimators.measure(settings)
    pace = {row["estimator"]: row["transitions a second"] for row in result.tables["Training speed of the estimators"]}
    assert pace["mc"] == pace["dql"] == pytest.approx(2 * 256)
    # Whole episodes of 1 to 8 steps: about as many transitions, of nearly twice as many places.
    assert pace["corr-mc"] == pytest.approx(2 * 256, rel=0.1)
    assert [ratio.value for ratio in result.ratios] == [1.0, pytest.approx(1.0, rel=0.1)]
