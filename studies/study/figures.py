"""Figures of a study, drawn from its scores: bars by row with intervals, success over an option, sorted settings."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from graspq.common.files import committed
from graspq.studies.study.comparisons import Place, Scored

INK, PALE = "#22262e", "#6b7280"
COLORS = (
    "#3b6fb6", "#c8553d", "#5b9a5b", "#8c6bb1", "#d99b2b", "#4aa3a2", "#a25b76", "#7b7f86",
    "#8a6a3b", "#9ab8dd", "#e8a698", "#b5cf8a", "#c9b3dd",
)  # fmt: skip
Rows = Mapping[Place, Mapping[str, Scored]]
Trainings = Mapping[Place, Mapping[str, Sequence[tuple[str, float]]]]
References = Mapping[str, Sequence[Mapping[str, Any]]]


@matplotlib.rc_context({"text.parse_math": False})  # names are names, whatever they hold
def write_figures(study: str, rows: Rows, runs: Trainings, references: References, folder: Path) -> list[Path]:
    """Draw what the scores are enough for; return the files, PNG.

    Source: Quillen et al. 2018, the bar plots of section "Experimental Results", and the figure of hyperparameters.
    """
    figures = {f"study-{study}.png": bars(rows, references)}
    over = over_an_option(rows)
    if over is not None:
        figures[f"study-{study}-over.png"] = over
    ranked = sorted_settings(runs)
    if ranked is not None:
        figures[f"study-{study}-sorted.png"] = ranked
    for name, figure in figures.items():
        with committed(folder / name) as temporary:
            figure.savefig(temporary, format="png", dpi=150, facecolor="white")
    return [folder / name for name in figures]


def bars(rows: Rows, references: References) -> Figure:
    """Return the bars: a panel a task, a group for each size and setting, a bar for each row, a dot for each run.

    They lie, so that names can be read however many there are; rows of one estimator have one colour.
    """
    tasks = list(dict.fromkeys(place.task for place in rows))
    algos = list(dict.fromkeys(row.algo for here in rows.values() for row in here.values()))
    counts = [sum(len(here) + 1 for place, here in rows.items() if place.task == task) for task in tasks]
    figure = Figure(figsize=(7.2, sum(0.9 + 0.23 * count for count in counts)), layout="constrained")
    panels = figure.subplots(len(tasks), 1, height_ratios=counts)
    for axes, task in zip(np.atleast_1d(panels), tasks, strict=True):
        place_of, ticks, labels = 0.0, list[float](), list[str]()
        for place, here in rows.items():
            if place.task != task:
                continue
            for row in here.values():
                color = COLORS[algos.index(row.algo) % len(COLORS)]
                mean = row.mean
                error = [[max(mean.value - mean.low, 0.0)], [max(mean.high - mean.value, 0.0)]]
                axes.barh(place_of, mean.value, 0.78, color=color, alpha=0.85)
                axes.errorbar(mean.value, place_of, xerr=error, color=INK, capsize=2.5, linewidth=1.1)
                spread = np.linspace(-0.2, 0.2, len(row.rates)) if len(row.rates) > 1 else [0.0]
                axes.plot(row.rates, place_of + np.asarray(spread), ".", color=INK, markersize=3.5, alpha=0.6)
                ticks.append(place_of)
                labels.append(row.name if _alone(rows, task) else f"{row.name}, {place.size}{_setting(place)}")
                place_of += 1
            place_of += 0.6
        for one in references.get(task, []):
            axes.axvline(one["success_rate"], color=PALE, linewidth=0.9, linestyle=":")
            axes.annotate(
                one["policy"], (one["success_rate"], 0.0), xycoords=("data", "axes fraction"), size=7, color=PALE,
                xytext=(2, 2), textcoords="offset points",
            )  # fmt: skip
        axes.set_yticks(ticks, labels)
        axes.set_ylim(place_of - 0.6, -0.8)  # the first row on top
        split = next(place.split for place in rows if place.task == task)
        several = any(row.several for place, here in rows.items() if place.task == task for row in here.values())
        label = "mean success of training seeds" if several else "success of one training of each row"
        label += ", with 95 % intervals"
        _frame(axes, f"{task.capitalize()} task, {split} split", "x", label)
    return figure


def _alone(rows: Rows, task: str) -> bool:
    return sum(place.task == task for place in rows) == 1


def _setting(place: Place) -> str:
    return "" if place.setting == "off-policy" else f", {place.setting}"


def _frame(axes: Axes, title: str, along: Literal["x", "y"] = "y", label: str = "success") -> None:
    axes.set(**{f"{along}lim": (0, 1), f"{along}label": label})
    getattr(axes, f"{along}axis").label.set(size=8, color=INK)
    axes.set_title(title, size=9, loc="left", color=INK)
    axes.grid(axis=along, color="#e5e7eb", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8, colors=INK)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def over_an_option(rows: Rows) -> Figure | None:
    """Return success over the option that most rows of one estimator differ in, such as n; None where there is none."""
    curves: dict[tuple[str, str, Place, frozenset[tuple[str, str]]], list[tuple[float, Scored]]] = {}
    for place, here in rows.items():
        for row in here.values():
            options = row.rows[0]["options"]
            for name, value in options.items():
                number = _number(value)
                if number is not None and name in _varied(here, row.algo):
                    # Only where nothing else differs is it a curve.
                    others = frozenset(options.items()) - {(name, value)}
                    curves.setdefault((row.algo, name, place, others), []).append((number, row))
    kept = {key: sorted(points, key=lambda one: one[0]) for key, points in curves.items() if len(points) >= 3}
    if not kept:
        return None
    panels = sorted({(algo, name) for algo, name, _, _ in kept})
    figure = Figure(figsize=(4.6 * len(panels), 3.4), layout="constrained")
    for axes, (algo, option) in zip(np.atleast_1d(figure.subplots(1, len(panels))), panels, strict=True):
        some = [(place, points) for (one, name, place, _), points in kept.items() if (one, name) == (algo, option)]
        for index, (place, points) in enumerate(some):
            x, means = [value for value, _ in points], [row.mean for _, row in points]
            color = COLORS[index % len(COLORS)]
            axes.plot(
                x, [one.value for one in means], "o-", color=color, markersize=4, label=f"{place.task}, {place.size}"
            )
            axes.fill_between(x, [one.low for one in means], [one.high for one in means], color=color, alpha=0.15)
        axes.set_xlabel(option, size=8, color=INK)
        axes.legend(fontsize=7, frameon=False)
        _frame(axes, f"`{algo}`: success over {option}".replace("`", ""))
    return figure


def _varied(here: Mapping[str, Scored], algo: str) -> set[str]:
    """Return the options in which the rows of an estimator differ."""
    options = [row.rows[0]["options"] for row in here.values() if row.algo == algo]
    names = {name for one in options for name in one}
    return {name for name in names if len({one.get(name) for one in options}) > 1}


def _number(value: str) -> float | None:
    try:
        return float(value)
    except ValueError:
        return None


def sorted_settings(runs: Trainings) -> Figure | None:
    """Return every training of an estimator, sorted by success, best first; None where no estimator has variants."""
    (here,) = runs.values() if len(runs) == 1 else ({},)
    if len(here) < 2 or max(len({name for name, _ in some}) for some in here.values()) < 3:
        return None
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = figure.subplots()
    for index, (algo, some) in enumerate(here.items()):
        ranked = sorted((rate for _, rate in some), reverse=True)
        style = "o-" if index < len(COLORS) else "s--"
        axes.plot(range(1, len(ranked) + 1), ranked, style, markersize=3, color=COLORS[index % len(COLORS)], label=algo)
    axes.set_xlabel("rank of the training within its estimator; one that failed stands at 0", size=8, color=INK)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend(fontsize=7, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    _frame(axes, "Success of every training, sorted")
    return figure
