"""The figures of a report: learning curves, calibration, film strips.

Each function turns findings into what the template draws.
"""

import base64
import io
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from PIL import Image

from graspq.evaluate.films import Film, read_films
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
    charts = [_calibration_chart("Held-back data", "estimated Q of the logged last action", held_back)]
    for (task, split, *_), scores in findings.panels.items():
        candidates = [score for score in scores if not score.is_reference]
        series = [_calibration_series(one.name, colors[one.name], calibration_of(one.rows)) for one in candidates]
        charts.append(_calibration_chart(f"Own grasps, {task} {split}", "Q of the chosen last action", series))
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


def film_groups(findings: Findings) -> list[dict[str, Any]]:
    """Return the film strips, grouped by policy; those of candidates stand open."""
    groups = []
    for (task, split, *_), scores in findings.panels.items():
        for score in sorted(scores, key=lambda score: (score.is_reference, -score.rate)):
            films = read_films(score.evaluations[0])
            if films:
                drawn = [_film(film) for film in films]
                scenes = f"{task} task, {split} split"
                groups.append({"name": score.name, "scenes": scenes, "films": drawn, "open": not score.is_reference})
    return groups


def _film(film: Film) -> dict[str, Any]:
    row = film.row
    what = f"lifted {row.lifted_object}" if row.lifted_object is not None else "lifted nothing"
    how = "after coming down" if row.end == "height" else "at the last step"
    q = f", Q {row.q:.2f}" if row.q is not None else ""
    actions = f"{row.steps} action{'s' if row.steps != 1 else ''}"
    frames = []
    for index, frame in enumerate(film.frames):
        last = index == len(film.frames) - 1
        caption = "after the lift" if last else f"t = {index}"
        alt = "Bin after the lift" if last else f"Bin before action {index + 1}"
        height, width = frame.shape[:2]
        frames.append({"png": _png(frame), "alt": alt, "caption": caption, "width": width, "height": height})
    return {
        "success": row.success,
        "caption": f"episode {row.episode}: {what}, closed {how}, {actions}{q}",
        "frames": frames,
    }


def _png(frame: np.ndarray) -> str:
    """Return uint8 [H, W, 3] as a PNG in base64."""
    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, format="PNG", optimize=True)
    return base64.b64encode(buffer.getvalue()).decode()
