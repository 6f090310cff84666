"""Geometry of charts: round ticks, coordinates inside the frame, curves without data left out."""

import math

import pytest

from graspq.report.charts import PLOT, Series, labelled, line_chart, nice_ticks, thinned


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.0, 1.0, [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]),
        (0.0, 8000.0, [0, 2000, 4000, 6000, 8000]),
        (0.43, 0.51, [0.42, 0.44, 0.46, 0.48, 0.5, 0.52]),
        (3.0, 3.0, [3.0]),
    ],
)
def test_ticks_are_round_and_enclose_the_range(low: float, high: float, expected: list[float]) -> None:
    assert nice_ticks(low, high, 6) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("ticks", "labels"),
    [
        ((0, 0.5, 1.0), ["0", "0.5", "1.0"]),
        ((0.48, 0.5), ["0.48", "0.50"]),
        ((0, 1500), ["0", "1500"]),
        ((0, 5000, 10_000), ["0", "5k", "10k"]),
        ((500_000, 1_500_000), ["0.5M", "1.5M"]),
    ],
)
def test_the_labels_of_an_axis_are_short_and_have_equally_many_decimals(
    ticks: tuple[float, ...], labels: list[str]
) -> None:
    assert labelled(ticks) == list(zip(ticks, labels, strict=True))


def test_corners_of_the_data_are_corners_of_the_plot() -> None:
    series = [Series("a", 0, [(0, 0), (1, 1)], dots=[2.0, 4.0])]
    chart = line_chart("t", "d", series, x_label="x", y_label="y", x_range=(0, 1), y_range=(0, 1), diagonal=True)
    assert chart is not None
    (drawn,) = chart.series
    corners = [(PLOT["left"], PLOT["bottom"], 2.0), (PLOT["right"], PLOT["top"], 4.0)]
    assert drawn.dots == [pytest.approx(corner) for corner in corners]
    assert drawn.path == f"M{drawn.dots[0][0]} {drawn.dots[0][1]} L{drawn.dots[1][0]} {drawn.dots[1][1]}"
    assert chart.diagonal == pytest.approx((PLOT["left"], PLOT["bottom"], PLOT["right"], PLOT["top"]))


def test_the_first_spike_of_a_loss_does_not_flatten_the_rest() -> None:
    points = [(step, 100.0 if step < 3 else 0.5 + 0.001 * step) for step in range(100)]
    chart = line_chart("t", "d", [Series("a", 0, points)], x_label="x", y_label="y")
    assert chart is not None
    assert float(chart.y_ticks[-1][1]) < 1


def test_points_that_are_not_finite_and_series_without_points_are_left_out() -> None:
    series = [Series("a", 0, [(0, math.nan), (1, 2.0)]), Series("b", 1, [])]
    chart = line_chart("t", "d", series, x_label="x", y_label="y")
    assert chart is not None
    assert [drawn.name for drawn in chart.series] == ["a"]
    assert line_chart("t", "d", series[1:], x_label="x", y_label="y") is None


def test_thinning_keeps_the_mean_and_short_curves_as_they_are() -> None:
    points = [(float(step), float(step % 7)) for step in range(1000)]
    few = thinned(points, 100)
    assert len(few) == 100
    assert sum(y for _, y in few) / 100 == pytest.approx(sum(y for _, y in points) / 1000)
    assert thinned(points[:50], 100) == points[:50]
