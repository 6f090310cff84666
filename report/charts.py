"""Geometry of the report's charts: numbers in, coordinates and labels out; the template draws them.

Nothing here knows colours or markup, so that the page can follow the reader's light or dark mode.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

WIDTH, HEIGHT = 480, 300
LEFT, RIGHT, TOP, BOTTOM = 62, 22, 14, 46
MOST_POINTS = 240
PLOT = {"left": LEFT, "right": WIDTH - RIGHT, "top": TOP, "bottom": HEIGHT - BOTTOM}  # where curves are drawn

Points = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Series:
    """One curve.

    Attributes:
        name: for the legend.
        color: index of its colour in the page's palette.
        points: (x, y) in data units.
        quiet: drawn thin and pale, such as the training loss beside the held-back one.
        dots: sizes (radii) of dots at the points; empty for none.
        band: (x, low, high), drawn pale behind the curve; empty for none.
    """

    name: str
    color: int
    points: Points
    quiet: bool = False
    dots: Sequence[float] = ()
    band: Sequence[tuple[float, float, float]] = ()


@dataclass(frozen=True)
class DrawnSeries:
    """A series in the chart's coordinates."""

    name: str
    color: int
    quiet: bool
    path: str
    dots: list[tuple[float, float, float]]
    band: str


@dataclass(frozen=True)
class LineChart:
    """A chart ready to draw; ticks are (coordinate, label)."""

    title: str
    description: str
    x_label: str
    y_label: str
    x_ticks: list[tuple[float, str]]
    y_ticks: list[tuple[float, str]]
    series: list[DrawnSeries]
    diagonal: tuple[float, float, float, float] | None
    width: int = WIDTH
    height: int = HEIGHT
    left: int = PLOT["left"]
    right: int = PLOT["right"]
    top: int = PLOT["top"]
    bottom: int = PLOT["bottom"]


def line_chart(
    title: str,
    description: str,
    series: Sequence[Series],
    *,
    x_label: str,
    y_label: str,
    x_range: tuple[float, float] | None = None,
    y_range: tuple[float, float] | None = None,
    diagonal: bool = False,
) -> LineChart | None:
    """Return a chart of some series, or None if none of them has a point.

    Args:
        title: heading.
        description: what a reader who cannot see the chart should know.
        series: the curves; points that are not finite are left out.
        x_label: name and unit of x.
        y_label: name and unit of y.
        x_range: least and greatest x; from the data by default.
        y_range: least and greatest y; from the data by default, without the first spike of a loss.
        diagonal: draw the line y = x.
    """
    kept = [(one, [point for point in one.points if all(map(math.isfinite, point))]) for one in series]
    kept = [(one, points) for one, points in kept if points]
    if not kept:
        return None
    low_x, high_x = x_range or _span([x for _, points in kept for x, _ in points])
    x_ticks = [tick for tick in nice_ticks(low_x, high_x, 6) if low_x <= tick <= high_x]
    low_y, high_y = y_range or _robust_span([points for _, points in kept])
    y_ticks = nice_ticks(low_y, high_y, 6)
    if y_range is None:
        low_y, high_y = min(low_y, y_ticks[0]), max(high_y, y_ticks[-1])

    def place(x: float, y: float) -> tuple[float, float]:
        across = LEFT + (x - low_x) / (high_x - low_x) * (WIDTH - LEFT - RIGHT)
        down = TOP + (high_y - y) / (high_y - low_y) * (HEIGHT - TOP - BOTTOM)
        return round(across, 1), round(down, 1)

    drawn = []
    for one, points in kept:
        placed = [place(x, y) for x, y in points]
        path = "M" + " L".join(f"{x} {y}" for x, y in placed)
        dots = [(x, y, radius) for (x, y), radius in zip(placed, one.dots, strict=False)]
        edge = [place(x, low) for x, low, _ in one.band] + [place(x, high) for x, _, high in reversed(one.band)]
        band = "M" + " L".join(f"{x} {y}" for x, y in edge) + " Z" if edge else ""
        drawn.append(DrawnSeries(one.name, one.color, one.quiet, path, dots, band))
    return LineChart(
        title,
        description,
        x_label,
        y_label,
        [(place(tick, low_y)[0], label) for tick, label in labelled(x_ticks)],
        [(place(low_x, tick)[1], label) for tick, label in labelled(y_ticks) if low_y <= tick <= high_y],
        drawn,
        (*place(low_x, low_x), *place(high_x, high_x)) if diagonal else None,
    )


def thinned(points: Points, most: int = MOST_POINTS) -> list[tuple[float, float]]:
    """Return at most `most` points, each the mean of an equal share of the points in order."""
    if len(points) <= most:
        return list(points)
    shares = np.array_split(np.asarray(points, dtype=float), most)
    return [(float(share[:, 0].mean()), float(share[:, 1].mean())) for share in shares]


def nice_ticks(low: float, high: float, count: int) -> list[float]:
    """Return about `count` round numbers (1, 2 or 5 times a power of ten) from `low` or below to `high` or above."""
    rough = max(high - low, 1e-12) / max(count - 1, 1)
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough * 0.999)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(index * step, 12) for index in range(first, last + 1)]


def labelled(ticks: Sequence[float]) -> list[tuple[float, str]]:
    """Return ticks with short labels of equally many decimals: `0.5`, `1.0`; 20000 is `20k`."""
    greatest = max(map(abs, ticks), default=0.0)
    unit, suffix = (1e6, "M") if greatest >= 1e6 else (1e3, "k") if greatest >= 1e4 else (1.0, "")
    decimals = max((len(f"{tick / unit:g}".partition(".")[2]) for tick in ticks), default=0)
    return [(tick, f"{tick / unit:.{decimals}f}{suffix}" if tick != 0 else "0") for tick in ticks]


def _span(values: Sequence[float]) -> tuple[float, float]:
    low, high = min(values), max(values)
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _robust_span(curves: Sequence[Points]) -> tuple[float, float]:
    """Return the range of y without the spike that a loss begins with: the first tenth of a long curve is left out."""
    kept = [y for points in curves for _, y in list(points)[len(points) // 10 :]]
    low, high = _span(kept)
    return low - 0.04 * (high - low), high + 0.04 * (high - low)
