"""Success rates in words and numbers: a panel's bars, differences and means over seeds; the table of evaluations."""

import json
from collections.abc import Sequence
from typing import Any

from graspq.evaluate.records import ORACLE, RANDOM, Evaluation
from graspq.evaluate.statistics import mean_over_seeds
from graspq.report.findings import PanelKey, RunData, Score, comparisons

REFERENCE_COLORS = {RANDOM: 8, ORACLE: 9}
PER_RUN = ("seed", "out")  # settings in which runs of one experiment may differ


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
    """Return a panel of success: bars, differences, means over training seeds."""
    counts = sorted({score.episodes for score in scores})
    episodes = f"{counts[0]:,}" if len(counts) == 1 else f"{counts[0]:,} to {counts[-1]:,}"
    name = set_name(scores[0].evaluations[0].summary)
    return {
        "title": f"{key.task.capitalize()} task, {key.split} split",
        "subtitle": f"{episodes} episodes a policy, object set {name} {key.objects[:8]}, settings {key.settings[:8]}",
        "bars": [_bar(score, colors) for score in scores],
        "comparisons": [
            {
                "first": first,
                "second": second,
                "difference": f"{100 * result.difference:+.1f}",
                "interval": f"{100 * result.low:+.1f} … {100 * result.high:+.1f}",
                "first_only": result.first_only,
                "second_only": result.second_only,
                "scenes": result.scenes,
                "p": f"{result.p_value:.3f}" if result.p_value >= 0.001 else "< 0.001",
            }
            for first, second, result in comparisons(scores)
        ],
        "seeds": _seed_means(scores, runs),
    }


def _bar(score: Score, colors: dict[str, int]) -> dict[str, Any]:
    low, high = score.interval
    summary = score.evaluations[0].summary
    checkpoint = summary.get("checkpoint_step")
    return {
        "name": score.name,
        "note": f"step {checkpoint:,}" if checkpoint is not None else "",
        "reference": score.is_reference,
        "color": REFERENCE_COLORS.get(score.policy or "", colors.get(score.name, 0)),
        "percent": round(100 * score.rate, 2),
        "low": round(100 * low, 2),
        "width": round(100 * (high - low), 2),
        "text": percent(score.rate),
        "interval": interval_text(low, high),
        "episodes": score.episodes,
    }


def _seed_means(scores: Sequence[Score], runs: Sequence[RunData]) -> list[dict[str, str]]:
    """Return the mean over runs that differ in their seed alone."""
    groups: dict[str, list[Score]] = {}
    settings = {run.name: run.settings for run in runs}
    for score in scores:
        if score.name in settings:
            shared = {name: value for name, value in settings[score.name].items() if name not in PER_RUN}
            groups.setdefault(json.dumps(shared, sort_keys=True, default=str), []).append(score)
    rows = []
    for group in groups.values():
        if len({settings[score.name].get("seed") for score in group}) < len(group) or len(group) < 2:
            continue
        mean = mean_over_seeds([score.rate for score in group])
        interval = interval_text(mean.low, mean.high) if mean.low is not None and mean.high is not None else "–"
        name = str(settings[group[0].name].get("algo", group[0].name))
        names = ", ".join(score.name for score in group)
        rows.append({"name": name, "runs": names, "mean": percent(mean.mean), "interval": interval})
    return rows


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
