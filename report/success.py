"""Success rates in words and numbers: a panel's bars, differences, rows of several training seeds; the evaluations."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from graspq.common.text import counted
from graspq.evaluate.choosing import ScoredCheckpoint, choosing
from graspq.evaluate.records import ORACLE, RANDOM, Evaluation
from graspq.report.charts import LineChart, Series, line_chart
from graspq.report.findings import PanelKey, RunData, Score
from graspq.report.rows import Row, best_of, comparisons, rows_of

REFERENCE_COLORS = {RANDOM: 8, ORACLE: 9}
PROFILE_POINTS = 161


def percent(rate: float, digits: int = 1) -> str:
    """Return a rate as a percentage."""
    return f"{100 * rate:.{digits}f}\N{NO-BREAK SPACE}%"


def interval_text(low: float, high: float) -> str:
    """Return an interval of rates in percent."""
    return f"{100 * low:.1f}\N{NO-BREAK SPACE}–\N{NO-BREAK SPACE}{100 * high:.1f}"


def set_name(summary: dict[str, Any]) -> str:
    """Return the name of an evaluation's object set."""
    return str(summary.get("object_set", {}).get("name", "unknown"))


def panel_of(key: PanelKey, scores: Sequence[Score], runs: Sequence[RunData], colors: dict[str, int]) -> dict[str, Any]:
    """Return a panel of success: bars, differences to the best, rows of several training seeds, what chooses well."""
    rows = rows_of(scores)
    counts = sorted({score.episodes for score in scores})
    episodes = f"{counts[0]:,}" if len(counts) == 1 else f"{counts[0]:,} to {counts[-1]:,}"
    name = set_name(scores[0].evaluations[0].summary)
    return {
        "title": f"{key.task.capitalize()} task, {key.split} split",
        "subtitle": f"{episodes} episodes a policy, object set {name} {key.objects[:8]}, settings {key.settings[:8]}",
        "bars": [_bar(row, colors) for row in rows],
        "best": getattr(best_of(rows), "name", ""),
        "comparisons": [
            {
                "other": one.other.name,
                "difference": f"{100 * one.difference.value:+.1f}",
                "interval": f"{100 * one.difference.low:+.1f} … {100 * one.difference.high:+.1f}",
                "runs": len(one.other.scores),
                "scenes": f"{one.scenes:,}",
                "p": _p_text(one.p_value),
                "holm": _p_text(one.adjusted),
            }
            for one in comparisons(rows)
        ],
        "seeds": _several(rows),
        "profile": profile_chart(rows, colors),
        "choosing": _choosing(scores, runs),
    }


def _p_text(p_value: float) -> str:
    return f"{p_value:.3f}" if p_value >= 0.001 else "< 0.001"


def _bar(row: Row, colors: dict[str, int]) -> dict[str, Any]:
    rate, first = row.rate, row.scores[0]
    checkpoint = first.evaluations[0].summary.get("checkpoint_step")
    notes = [counted(len(row.scores), "training seed")] if row.several else []
    notes += [f"step {checkpoint:,}"] if checkpoint is not None else []
    return {
        "name": row.name,
        "note": ", ".join(notes),
        "reference": row.is_reference,
        "color": REFERENCE_COLORS.get(first.policy or "", colors.get(first.name, 0)),
        "percent": round(100 * rate.value, 2),
        "low": round(100 * rate.low, 2),
        "width": round(100 * (rate.high - rate.low), 2),
        "text": percent(rate.value),
        "interval": interval_text(rate.low, rate.high),
        "episodes": sum(score.episodes for score in row.scores),
        "runs": [round(100 * score.rate, 2) for score in row.scores] if row.several else [],
    }


def _several(rows: Sequence[Row]) -> list[dict[str, str]]:
    """Return a line for each row of several training seeds, best first."""
    best, lines = best_of(rows), []
    for row in sorted((row for row in rows if row.several), key=lambda row: -row.rate.value):
        better = best.improvement(row) if best is not None and best is not row else None
        lines.append(
            {
                "name": row.name,
                "runs": ", ".join(f"{100 * score.rate:.1f}" for score in row.scores),
                "scenes": f"{len(row.scenes):,}",
                "mean": percent(row.rate.value),
                "interval": interval_text(row.rate.low, row.rate.high),
                "bootstrap": interval_text(row.bootstrap.low, row.bootstrap.high),
                "improvement": f"{better.value:.2f} ({better.low:.2f} – {better.high:.2f})" if better else "–",
            }
        )
    return lines


def profile_chart(rows: Sequence[Row], colors: dict[str, int]) -> LineChart | None:
    """Return the performance profiles of the rows with several training seeds; None where there is none."""
    several = [row for row in rows if row.several]
    rates = [score.rate for row in several for score in row.scores]
    if not rates:
        return None
    low, high = max(0.0, min(rates) - 0.05), min(1.0, max(rates) + 0.05)
    thresholds = np.linspace(low, high, PROFILE_POINTS)
    series = []
    for row in several:
        one = row.profile(thresholds)
        points = list(zip(thresholds.tolist(), one.share.tolist(), strict=True))
        band = list(zip(thresholds.tolist(), one.low.tolist(), one.high.tolist(), strict=True))
        series.append(Series(row.name, colors.get(row.scores[0].name, 0), points, band=band))
    said = (f"{row.name}: {', '.join(f'{score.rate:.3f}' for score in row.scores)}" for row in several)
    return line_chart(
        "Performance profile",
        "Success rates of single runs: " + "; ".join(said),
        series,
        x_label="success rate τ",
        y_label="share of runs above τ",
        x_range=(low, high),
        y_range=(0.0, 1.0),
    )


def _choosing(scores: Sequence[Score], runs: Sequence[RunData]) -> list[dict[str, str]]:
    """Return how well each measure of validation orders the checkpoints that a panel scores."""
    known = {run.name: run for run in runs}
    checkpoints = []
    for score in scores:
        run, step = known.get(score.name), score.evaluations[0].summary.get("checkpoint_step")
        validation = run.validation_at(step) if run is not None and step is not None else None
        if run is not None and validation is not None:
            checkpoints.append(ScoredCheckpoint(str(run.settings.get("algo")), validation, score.rate))
    return [
        {
            "measure": one.words,
            "checkpoints": str(one.checkpoints),
            "correlation": f"{one.correlation:+.2f}",
            "within": f"{one.within:+.2f}" if one.within is not None else "–",
        }
        for one in choosing(checkpoints)
    ]


def evaluation_row(score: Score, one: Evaluation) -> dict[str, Any]:
    """Return a row of the table of evaluations."""
    summary = one.summary
    ends = summary.get("ends", {})
    checkpoint = summary.get("checkpoint_step")
    return {
        "name": score.name,
        "task": summary["task"],
        "split": summary["split"],
        "seed": summary["seed"],
        "successes": f"{summary['successes']:,} of {summary['episodes']:,}",
        "rate": percent(summary["success_rate"]),
        "interval": interval_text(*summary["ci95"]),
        "steps": f"{summary['mean_steps']:.2f}",
        "height": percent(ends.get("height", 0) / summary["episodes"], 0),
        "checkpoint": f"{checkpoint:,}" if checkpoint is not None else "–",
    }
