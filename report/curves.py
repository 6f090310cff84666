"""The curves of a report, of learning and of calibration: what was found as charts that the template draws."""

from collections.abc import Iterable, Sequence

from graspq.report.charts import LineChart, Series, line_chart, thinned
from graspq.report.findings import Findings, RunData, calibration_of


def learning_curves(runs: Sequence[RunData], colors: dict[str, int]) -> list[LineChart]:
    """Return the charts of losses and of the ROC AUC over training steps; those without data are left out."""
    loss: list[Series] = []
    for run in runs:
        color = colors[run.name]
        loss.append(Series(f"{run.name}, training", color, thinned(run.curve("loss")), quiet=True))
        loss.append(Series(f"{run.name}, held back", color, thinned(run.curve("validation", "loss"))))
    auc = [Series(run.name, colors[run.name], thinned(run.curve("validation", "roc_auc_last_step"))) for run in runs]
    steps = (0.0, max((x for one in [*loss, *auc] for x, _ in one.points), default=1.0))
    charts = [
        line_chart(name, _ends(label, series), series, x_label="training step", y_label=label, x_range=steps)
        for name, label, series in (("Loss", "loss", loss), ("ROC AUC of the last step", "ROC AUC", auc))
    ]
    return [chart for chart in charts if chart is not None]


def _ends(what: str, series: Iterable[Series]) -> str:
    """Return a sentence with the last value of each curve, for readers who cannot see them."""
    ends = [f"{one.name} {one.points[-1][1]:.3f}" for one in series if one.points]
    return f"At the end, {what}: {', '.join(ends)}."


def calibration_charts(findings: Findings, colors: dict[str, int]) -> list[LineChart]:
    """Return the charts of calibration: on held-back data, and on each panel's own grasps."""
    held_back = [_calibration_series(run.name, colors[run.name], _validation_bins(run)) for run in findings.runs]
    charts = [_calibration_chart("Held-back training data", "Q of the logged last action", held_back)]
    for (task, split, *_), scores in findings.panels.items():
        candidates = [score for score in scores if not score.is_reference]
        series = [_calibration_series(one.name, colors[one.name], calibration_of(one.rows)) for one in candidates]
        charts.append(_calibration_chart(f"Evaluation, {task} task, {split} split", "Q of the last action", series))
    return [chart for chart in charts if chart is not None]


def _validation_bins(run: RunData) -> list[tuple[float, float, int]]:
    bins = (run.last_validation() or {}).get("calibration") or []
    return [(float(one["mean_q"]), float(one["success_rate"]), int(one["count"])) for one in bins if one.get("count")]


def _calibration_series(name: str, color: int, bins: Sequence[tuple[float, float, int]]) -> Series:
    most = max((count for _, _, count in bins), default=1)
    radii = [round(2.5 + 5.5 * (count / most) ** 0.5, 1) for _, _, count in bins]
    return Series(name, color, [(q, rate) for q, rate, _ in bins], dots=radii)


def _calibration_chart(title: str, x_label: str, series: Sequence[Series]) -> LineChart | None:
    texts = [f"{one.name}: " + ", ".join(f"Q {q:.2f} succeeds {rate:.2f}" for q, rate in one.points) for one in series]
    return line_chart(
        title,
        "; ".join(texts),
        series,
        x_label=x_label,
        y_label="share of successes",
        x_range=(0.0, 1.0),
        y_range=(0.0, 1.0),
        diagonal=True,
    )
