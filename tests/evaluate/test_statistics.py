"""Intervals against closed forms, published numbers and simulated coverage."""

import math

import numpy as np
import pytest
from scipy import stats

from graspq.evaluate.statistics import (
    bootstrap_interval,
    crossed_draws,
    holm,
    mean_success,
    object_counts,
    object_variance,
    paired_difference,
    performance_profile,
    probability_of_improvement,
    rank_correlation,
    success_difference,
    wilson_interval,
)


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


# Three runs, four scenes. Means: of the runs 1, 3/4, 1/4; of the scenes 1, 2/3, 2/3, 1/3.
SMALL = np.array([[1, 1, 1, 1], [1, 1, 1, 0], [1, 0, 0, 0]], dtype=bool)


def test_the_mean_over_runs_is_the_two_way_analysis_of_variance_worked_by_hand() -> None:
    result = mean_success(SMALL)
    mean = 2 / 3
    of_runs = 4 * ((1 - mean) ** 2 + (3 / 4 - mean) ** 2 + (1 / 4 - mean) ** 2)
    of_scenes = 3 * ((1 - mean) ** 2 + (1 / 3 - mean) ** 2)
    runs, scenes, residual = of_runs / 2, of_scenes / 3, (12 * mean * (1 - mean) - of_runs - of_scenes) / 6
    variance = (runs + scenes - residual) / 12
    freedom = variance**2 / ((runs / 12) ** 2 / 2 + (scenes / 12) ** 2 / 3)
    assert runs > residual > 0, "or nothing would be taken away"
    assert (result.value, result.scenes) == (pytest.approx(mean), 4)
    assert result.error == pytest.approx(math.sqrt(variance), rel=1e-12)
    assert result.freedom == pytest.approx(freedom, rel=1e-12)
    narrow = mean_success(SMALL, confidence=0.5)
    half = float(stats.t.ppf(0.75, freedom)) * math.sqrt(variance)
    assert mean_success(~SMALL).low == 0.0, "nor below 0"
    assert (narrow.low, narrow.high) == pytest.approx((mean - half, mean + half), rel=1e-12)
    assert result.low < narrow.low and result.high == 1.0, "no rate is above 1"


def test_the_difference_of_rows_is_worked_by_hand() -> None:
    other = np.array([[0, 1, 0, 1], [0, 0, 0, 1]], dtype=bool)
    first = np.array([[1, 1, 0, 1], [1, 1, 1, 0], [1, 0, 0, 1]], dtype=bool)
    # Means of the scenes 1, 2/3, 1/3, 2/3 and 0, 1/2, 0, 1; of the runs 3/4, 3/4, 1/2 and 1/2, 1/4.
    d = np.array([1, 2 / 3 - 1 / 2, 1 / 3, 2 / 3 - 1])
    residuals = []
    for runs in (first.astype(float), other.astype(float)):
        rest = runs - runs.mean(1)[:, None] - runs.mean(0)[None] + runs.mean()
        residuals.append(float((rest**2).sum()) / ((len(runs) - 1) * 3))
    parts = [(1 / 48) / 3, (1 / 32) / 2, float(np.var(d, ddof=1)) / 4]
    # The first row's runs differ by less than chance: their variance counts as 0, but not less.
    assert parts[0] < residuals[0] / 12
    assert parts[1] == pytest.approx(residuals[1] / 8)
    result = success_difference(first, other)
    assert result.value == pytest.approx(2 / 3 - 3 / 8)
    assert result.error == pytest.approx(math.sqrt(parts[2]), rel=1e-12)
    freedom = parts[2] ** 2 / (parts[0] ** 2 / 2 + parts[1] ** 2 / 1 + parts[2] ** 2 / 3)
    assert result.freedom == pytest.approx(freedom, rel=1e-12)
    assert result.p_value == pytest.approx(2 * stats.t.sf(result.value / result.error, freedom), rel=1e-9)


def test_a_difference_counts_the_runs_of_both_rows_and_the_scenes_once() -> None:
    rng = np.random.default_rng(3)
    scenes = rng.normal(size=4000)
    one = scenes + np.array([[0.0], [0.4], [0.8]]) + rng.normal(size=(3, 4000)) > 0
    two = scenes + np.array([[-0.5], [0.5]]) + rng.normal(size=(2, 4000)) > 0
    result = success_difference(one, two)
    runs = float(np.var(one.mean(1), ddof=1)) / 3 + float(np.var(two.mean(1), ddof=1)) / 2
    assert result.error**2 == pytest.approx(runs, rel=0.02), "between scenes and residuals there is next to nothing"
    assert 1 < result.freedom < 2


def test_one_run_has_the_error_of_its_scenes_alone() -> None:
    success = np.arange(50) % 5 > 0
    result = mean_success(success[None])
    assert result.error == pytest.approx(math.sqrt(0.8 * 0.2 / 49))
    assert result.freedom == pytest.approx(49)


def test_where_nothing_varies_the_intervals_are_those_of_single_runs() -> None:
    certain = np.ones((3, 40), dtype=bool)
    result = mean_success(certain)
    assert (result.low, result.high) == wilson_interval(40, 40)
    assert result.error == pytest.approx((1 - result.low) / (2 * 1.959963984540054))
    alike, apart = success_difference(certain, certain), success_difference(certain, ~certain)
    assert (alike.low, alike.high, alike.p_value) == (-alike.high, alike.high, 1.0)
    assert alike.high == pytest.approx(paired_difference(certain[0], certain[0]).high)
    assert apart.value == apart.high == 1.0
    assert apart.low == paired_difference(certain[0], ~certain[0]).low
    assert apart.p_value < 1e-6
    # One success each, in different scenes: neither runs nor scenes differ.
    crossed = success_difference(np.eye(2, dtype=bool), np.zeros((2, 2), dtype=bool))
    assert crossed.low <= crossed.value == 0.5 <= crossed.high


def test_neither_the_order_of_runs_scenes_and_objects_nor_their_names_matter() -> None:
    rng = np.random.default_rng(5)
    success = rng.random((4, 60)) < rng.uniform(0.3, 0.9, 60)
    other = rng.random((3, 60)) < 0.5
    ids = [tuple(f"{name:02d}" for name in rng.choice(12, 3)) for _ in range(60)]
    renamed = [tuple(f"x{99 - int(name)}" for name in names) for names in ids]
    order = rng.permutation(60)
    expected = success_difference(success, other, object_counts(ids))
    again = success_difference(
        success[::-1][:, order], other[[2, 0, 1]][:, order], object_counts([renamed[place] for place in order])
    )
    assert (again.value, again.error, again.freedom) == pytest.approx(
        (expected.value, expected.error, expected.freedom), rel=1e-9
    )


def test_rows_that_change_places_change_the_sign_and_failures_mirror_successes() -> None:
    rng = np.random.default_rng(6)
    one, two = rng.random((4, 80)) < 0.7, rng.random((2, 80)) < 0.5
    counts = object_counts([tuple(map(str, rng.choice(9, 3))) for _ in range(80)])
    forth, back = success_difference(one, two, counts), success_difference(two, one, counts)
    assert (forth.value, forth.low, forth.high) == pytest.approx((-back.value, -back.high, -back.low))
    assert forth.p_value == pytest.approx(back.p_value)
    rate, failures = mean_success(one, counts), mean_success(~one, counts)
    assert (rate.value, rate.low, rate.high) == pytest.approx((1 - failures.value, 1 - failures.high, 1 - failures.low))


def test_outcomes_in_other_scenes_or_of_no_shape_are_refused() -> None:
    with pytest.raises(ValueError, match="the same scenes, got 4 and 2"):
        success_difference(SMALL, SMALL[:, :2])
    for wrong in (SMALL[0], SMALL[:, :1], SMALL[:0]):
        with pytest.raises(ValueError, match="at least two scenes"):
            mean_success(wrong)


def test_the_variance_of_objects_is_the_slope_over_all_pairs_of_scenes() -> None:
    rng = np.random.default_rng(7)
    ids = [tuple(map(str, rng.choice(6, 2))) for _ in range(30)]  # the same object may lie there twice
    counts = object_counts(ids)
    assert counts.shape == (30, 6) and (counts.sum(1) == 2).all()
    score = counts @ np.array([0.5, -0.4, 0.3, 0.0, 0.2, -0.6]) + 0.05 * rng.normal(size=30)
    pairs = [(s, t) for s in range(30) for t in range(30) if s != t]
    shared = [sum(ids[s].count(name) * ids[t].count(name) for name in set(ids[s])) for s, t in pairs]
    products = [(score[s] - score.mean()) * (score[t] - score.mean()) for s, t in pairs]
    slope = float(stats.linregress(shared, products).slope)
    assert slope > 0.05
    expected = slope * sum((sum(names.count(str(o)) for names in ids) / 30) ** 2 for o in range(6))
    assert object_variance(score, counts) == pytest.approx(expected, rel=1e-9)


def test_objects_that_say_nothing_add_no_variance() -> None:
    score = np.array([1.0, 0.0, 1.0, 0.0])
    assert object_variance(score, object_counts([("a",)] * 4)) == 0.0
    assert object_variance(score, object_counts([("a",), ("b",), ("c",), ("d",)])) == 0.0
    # Scenes that share an object differ more than others: no variance, rather than a negative one.
    assert object_variance(score, object_counts([("a",), ("a",), ("b",), ("b",)])) == 0.0
    assert object_variance(score, object_counts([("a",), ("b",), ("a",), ("b",)])) > 0


def simulated(
    rng: np.random.Generator, runs: int, scenes: int, run_spread: float, object_spread: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return outcomes of runs whose expected success over runs, scenes and objects is 0.9, and the objects' counts."""
    counts = np.zeros((scenes, 100))
    np.put_along_axis(counts, rng.random((scenes, 100)).argsort(1)[:, :5], 1.0, 1)
    run, scene = rng.normal(0, run_spread, (runs, 1)), rng.normal(size=scenes)
    hard = counts @ rng.normal(0, object_spread, 100)
    total = math.sqrt(2 + run_spread**2 + 5 * object_spread**2)
    return 1.2815515655446004 * total + run + scene + hard + rng.normal(size=(runs, scenes)) > 0, counts


@pytest.mark.parametrize(("run_spread", "object_spread"), [(0.0, 0.0), (0.3, 0.0), (0.0, 0.3), (0.2, 0.2)])
def test_the_interval_over_runs_scenes_and_objects_covers_what_new_ones_would_reach(
    run_spread: float, object_spread: float
) -> None:
    rng = np.random.default_rng(8)
    results = [mean_success(*simulated(rng, 5, 300, run_spread, object_spread)) for _ in range(300)]
    covered = np.mean([result.low <= 0.9 <= result.high for result in results])
    assert 0.92 <= covered <= 0.99


def test_without_its_objects_or_its_runs_an_interval_would_cover_too_rarely() -> None:
    rng = np.random.default_rng(9)
    without_objects, without_runs = 0, 0
    for _ in range(150):
        success, _ = simulated(rng, 5, 600, 0.0, 0.4)
        result = mean_success(success)
        without_objects += result.low <= 0.9 <= result.high
        success, counts = simulated(rng, 1, 600, 0.4, 0.0)
        result = mean_success(success, counts)
        without_runs += result.low <= 0.9 <= result.high
    assert without_objects < 110 and without_runs < 110


def test_equal_rows_are_told_apart_about_5_times_in_100() -> None:
    rng = np.random.default_rng(10)
    alarms = 0
    for _ in range(400):
        scenes = rng.normal(size=200)
        one, two = (1 + rng.normal(0, 0.2, (n, 1)) + scenes + rng.normal(size=(n, 200)) > 0 for n in (5, 3))
        alarms += success_difference(one, two).p_value < 0.05
    assert 8 <= alarms <= 28


def test_draws_resample_the_same_scenes_for_all_rows_and_runs_for_each() -> None:
    scenes = np.arange(30) % 3 > 0
    alike = np.stack([scenes] * 4)
    one, two = crossed_draws([alike, alike[:2]], 500, np.random.default_rng(0))
    assert (one.shape, two.shape) == ((500, 4), (500, 2))
    assert np.array_equal(one[:, 0], two[:, 1]) and np.ptp(one, axis=1).max() == 0
    assert one.var() == pytest.approx((2 / 9) / 30, rel=0.2)
    apart = np.stack([np.ones(30), np.zeros(30)])
    (rates,) = crossed_draws([apart], 4000, np.random.default_rng(0))
    assert set(np.unique(np.round(rates, 12))) == {0.0, 1.0}
    assert rates.mean() == pytest.approx(0.5, abs=0.02) and rates.mean(1).var() == pytest.approx(1 / 8, rel=0.05)


def test_the_bootstrap_has_the_spread_of_the_parts_that_it_resamples() -> None:
    rng = np.random.default_rng(11)
    strata = [rng.random((6, 200)) < rng.uniform(0.5, 1.0, (6, 1)), rng.random((4, 100)) < 0.3]
    result = bootstrap_interval(strata, np.random.default_rng(0), draws=4000)
    assert result.value == pytest.approx((strata[0].mean() + strata[1].mean()) / 2)
    variance = 0.0
    for runs in strata:
        # Of the resampled mean: n - 1 of n parts of each variance, and what is left of single outcomes.
        (count, scenes), rest = runs.shape, runs - runs.mean(1, keepdims=True) - runs.mean(0) + runs.mean()
        variance += (runs.mean(1).var() / count + runs.mean(0).var() / scenes + (rest**2).mean() / runs.size) / 4
    assert result.high - result.low == pytest.approx(2 * 1.96 * math.sqrt(variance), rel=0.06)


def test_the_probability_of_improvement_counts_pairs_of_runs_ties_as_half() -> None:
    def rows(*counts: int) -> np.ndarray:
        return np.array([[scene < count for scene in range(10)] for count in counts])

    first, second = rows(3, 5, 9), rows(5, 2)
    result = probability_of_improvement(first, second, np.random.default_rng(0))
    assert result.value == pytest.approx((0 + 1 + 0.5 + 1 + 1 + 1) / 6)
    assert result.low <= result.value <= result.high
    back = probability_of_improvement(second, first, np.random.default_rng(0))
    assert back.value == pytest.approx(1 - result.value)
    certain = probability_of_improvement(rows(10, 10), rows(0, 0), np.random.default_rng(0))
    assert (certain.low, certain.value, certain.high) == (1.0, 1.0, 1.0)
    alike = probability_of_improvement(first[:1], first[:1], np.random.default_rng(0))
    assert (alike.low, alike.value, alike.high) == (0.5, 0.5, 0.5)


def test_the_performance_profile_falls_from_one_to_zero_at_the_rates_of_the_runs() -> None:
    success = np.array([[scene < count for scene in range(10)] for count in (4, 8, 8, 9)])
    thresholds = np.array([0.0, 0.39, 0.4, 0.5, 0.8, 0.9, 1.0])
    profile = performance_profile(success, thresholds, np.random.default_rng(0))
    assert profile.share.tolist() == [1.0, 1.0, 0.75, 0.75, 0.25, 0.0, 0.0]
    assert (profile.low <= profile.high).all() and (np.diff(profile.low) <= 0).all()
    assert profile.low[3] < 0.75 < profile.high[3] and profile.high[-1] == 0.0
    assert profile.low.tolist() != profile.high.tolist()
    # Of four runs that one draw has none of the three best ones: (1/4)^4.
    assert 0.25 <= profile.low[3] <= 0.5 and profile.high[3] == 1.0


def test_holms_correction_is_that_of_a_worked_example() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.7, 0.9]) == [1.0, 1.0]
    assert holm([0.04]) == [0.04] and holm([]) == []


def test_holms_correction_raises_a_false_alarm_in_a_family_at_most_5_times_in_100() -> None:
    rng = np.random.default_rng(12)
    p_values = rng.random((2000, 6))
    alarms = np.mean([min(holm(list(row))) < 0.05 for row in p_values])
    assert 0.035 <= alarms <= 0.06
    assert np.mean(p_values.min(1) < 0.05) > 0.2


def test_the_rank_correlation_is_that_of_scipy_with_and_without_ties() -> None:
    rng = np.random.default_rng(13)
    for first, second in ((rng.random(30), rng.random(30)), (rng.integers(0, 5, 40), rng.integers(0, 4, 40))):
        expected = float(stats.spearmanr(first, second).statistic)
        assert rank_correlation(list(first), list(second)) == pytest.approx(expected, abs=1e-12)
    assert rank_correlation([1, 2, 3], [10, 100, 1000]) == pytest.approx(1.0)
    assert rank_correlation([1, 2, 3], [3, 2, 1]) == pytest.approx(-1.0)
    assert rank_correlation([1, 1], [2, 3]) is None and rank_correlation([1], [1]) is None
