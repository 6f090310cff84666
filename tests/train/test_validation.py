"""Measures of a Q-function against hand values and brute force."""

import numpy as np
import pytest

from graspq.train.validation import calibration, opc, roc_auc, soft_opc


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


def test_opc_is_the_best_threshold_found_by_trying_all() -> None:
    rng = np.random.default_rng(2)
    q = rng.integers(0, 15, 200) / 15
    success = rng.random(200) < 0.2 + 0.5 * q
    everywhere = [np.mean(q[success] > b) - np.mean(q > b) for b in [-1.0, *np.unique(q)]]
    assert opc(q, success) == pytest.approx(max(everywhere), abs=1e-12)
    assert max(everywhere) > 0.05


def test_opc_of_a_perfect_q_is_the_share_of_other_steps_and_knows_the_order_alone() -> None:
    success = np.array([True, True, False, False, False])
    q = np.array([0.9, 0.8, 0.3, 0.2, 0.1])
    assert opc(q, success) == pytest.approx(3 / 5)
    assert opc(np.exp(5 * q), success) == opc(q, success)
    assert opc(-q, success) == 0.0 and opc(np.ones(5), success) == 0.0


def test_soft_opc_is_the_mean_over_successes_less_the_mean_over_all_and_scales_with_q() -> None:
    success = np.array([True, True, False, False])
    q = np.array([0.9, 0.5, 0.2, 0.0])
    assert soft_opc(q, success) == pytest.approx(0.7 - 0.4)
    assert soft_opc(2 * q + 5, success) == pytest.approx(0.6)
    assert soft_opc(1 - q, success) == pytest.approx(-0.3)


def test_without_a_success_there_is_no_opc() -> None:
    for measure in (opc, soft_opc):
        assert measure(np.array([0.1, 0.2]), np.array([False, False])) is None
        assert measure(np.zeros(0), np.zeros(0, dtype=bool)) is None


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
