"""Measures of a Q-function against hand values and brute force."""

import numpy as np
import pytest

from graspq.train.validation import calibration, roc_auc


def test_the_area_under_the_roc_curve_is_the_share_of_pairs_in_order() -> None:
    rng = np.random.default_rng(0)
    score = rng.integers(0, 20, 300).astype(np.float64)
    positive = rng.random(300) < 0.3
    pairs = score[positive][:, None] - score[~positive][None, :]
    expected = (np.sum(pairs > 0) + 0.5 * np.sum(pairs == 0)) / pairs.size
    assert roc_auc(score, positive) == pytest.approx(expected, abs=1e-12)


def test_perfect_reversed_and_constant_scores_have_areas_one_zero_and_a_half() -> None:
    positive = np.array([False, False, True])
    assert roc_auc(np.array([0.1, 0.2, 0.3]), positive) == 1.0
    assert roc_auc(np.array([0.3, 0.2, 0.1]), positive) == 0.0
    assert roc_auc(np.array([0.5, 0.5, 0.5]), positive) == 0.5


def test_without_both_outcomes_there_is_no_area() -> None:
    assert roc_auc(np.array([0.1, 0.2]), np.array([True, True])) is None
    assert roc_auc(np.array([]), np.array([], dtype=bool)) is None


def test_calibration_counts_bins_and_weighs_their_distance() -> None:
    rows, error = calibration(np.array([0.05, 0.07, 0.95, 1.2]), np.array([0.0, 1.0, 1.0, 1.0]))
    assert [row["count"] for row in rows] == [2, 0, 0, 0, 0, 0, 0, 0, 0, 2]
    assert rows[0]["mean_q"] == pytest.approx(0.06) and rows[0]["success_rate"] == 0.5
    assert rows[1]["mean_q"] is None and rows[1]["success_rate"] is None
    assert rows[9]["mean_q"] == pytest.approx(0.975), "Q beyond 1 counts as 1"
    assert error == pytest.approx(0.5 * 0.44 + 0.5 * 0.025)
    assert (rows[3]["low"], rows[3]["high"]) == (0.3, 0.4)


def test_a_calibrated_q_has_a_small_error_and_a_shifted_one_its_shift() -> None:
    rng = np.random.default_rng(1)
    q = rng.uniform(0.2, 0.7, 200_000)
    outcome = (rng.random(len(q)) < q).astype(np.float64)
    _, error = calibration(q, outcome)
    assert error is not None and error < 0.01
    _, error = calibration(q + 0.2, outcome)
    assert error == pytest.approx(0.2, abs=0.01)


def test_no_samples_have_no_calibration_error() -> None:
    rows, error = calibration(np.array([]), np.array([]))
    assert error is None and len(rows) == 10
