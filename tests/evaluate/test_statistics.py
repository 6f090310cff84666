"""Intervals against closed forms, published numbers and simulated coverage."""

import math

import numpy as np
import pytest
from scipy import stats

from graspq.evaluate.statistics import mean_over_seeds, paired_difference, wilson_interval


@pytest.mark.parametrize(("successes", "trials"), [(0, 10), (1, 1), (5, 10), (610, 1000), (999, 1000), (20, 20)])
def test_wilson_interval_is_that_of_scipy(successes: int, trials: int) -> None:
    for confidence in (0.95, 0.8):
        theirs = stats.binomtest(successes, trials).proportion_ci(confidence, method="wilson")
        assert wilson_interval(successes, trials, confidence) == pytest.approx((theirs.low, theirs.high), abs=1e-12)


def test_wilson_interval_of_a_rare_event_stays_within_zero_and_one() -> None:
    low, high = wilson_interval(0, 20)
    assert low == 0.0
    assert high == pytest.approx(0.1611, abs=1e-4)
    assert wilson_interval(20, 20) == pytest.approx((1 - high, 1.0))


def test_wilson_interval_refuses_what_is_no_count() -> None:
    for successes, trials in [(1, 0), (3, 2), (-1, 5)]:
        with pytest.raises(ValueError):
            wilson_interval(successes, trials)


def test_wilson_interval_covers_the_true_rate_about_95_times_in_100() -> None:
    rng = np.random.default_rng(0)
    counts = rng.binomial(200, 0.85, size=4000)
    intervals = {int(k): wilson_interval(int(k), 200) for k in np.unique(counts)}
    covered = np.mean([intervals[int(k)][0] <= 0.85 <= intervals[int(k)][1] for k in counts])
    assert 0.935 <= covered <= 0.965


def test_paired_difference_is_the_bonett_price_interval_worked_by_hand() -> None:
    first = [True] * 10 + [True] * 20 + [False] * 5 + [False] * 15
    second = [True] * 10 + [False] * 20 + [True] * 5 + [False] * 15
    result = paired_difference(first, second)
    p1, p2 = 21 / 52, 6 / 52
    half = 1.959963984540054 * math.sqrt((p1 + p2 - (p1 - p2) ** 2) / 52)
    assert (result.first_only, result.second_only, result.scenes) == (20, 5, 50)
    assert result.difference == pytest.approx(15 / 50)
    assert (result.low, result.high) == pytest.approx((p1 - p2 - half, p1 - p2 + half), abs=1e-12)
    assert result.p_value == pytest.approx(2 * sum(math.comb(25, k) for k in range(6)) / 2**25, rel=1e-9)


def test_paired_difference_changes_sign_when_the_policies_change_places() -> None:
    rng = np.random.default_rng(1)
    first, second = rng.random(300) < 0.6, rng.random(300) < 0.5
    forth, back = paired_difference(first, second), paired_difference(second, first)
    assert forth.difference == pytest.approx(-back.difference)
    assert (forth.low, forth.high) == pytest.approx((-back.high, -back.low))
    assert forth.p_value == pytest.approx(back.p_value)


def test_paired_difference_of_equal_policies_contains_zero_and_is_narrower_than_unpaired() -> None:
    successes = np.arange(1000) % 3 == 0
    result = paired_difference(successes, successes)
    assert result.difference == 0.0
    assert result.p_value == 1.0
    assert result.low < 0.0 < result.high
    low, high = wilson_interval(int(successes.sum()), 1000)
    assert result.high - result.low < (high - low) / 4


def test_paired_difference_refuses_lists_of_different_scenes() -> None:
    with pytest.raises(ValueError, match="equally long"):
        paired_difference([True, False], [True])
    with pytest.raises(ValueError, match="equally long"):
        paired_difference([], [])


def test_mean_over_seeds_is_students_interval() -> None:
    result = mean_over_seeds([0.60, 0.64, 0.62])
    assert result.mean == pytest.approx(0.62)
    assert result.deviation == pytest.approx(0.02)
    assert result.high is not None
    assert result.high - result.mean == pytest.approx(4.302652729911275 * 0.02 / math.sqrt(3), rel=1e-9)


def test_mean_over_one_seed_has_no_interval_and_over_none_is_refused() -> None:
    single = mean_over_seeds([0.5])
    assert (single.mean, single.low, single.high, single.deviation, single.seeds) == (0.5, None, None, None, 1)
    with pytest.raises(ValueError, match="at least one seed"):
        mean_over_seeds([])
