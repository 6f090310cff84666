"""One self-contained HTML page that shows runs and evaluations: success, learning, calibration, films, settings.

Python prepares numbers, coordinates and sentences; `templates/report.html` alone knows how they look.
"""

from collections.abc import Sequence
from pathlib import Path

import jinja2

import graspq
from graspq.common.errors import UserError
from graspq.common.files import write_text
from graspq.common.text import counted
from graspq.evaluate.records import ORACLE, RANDOM
from graspq.report.charts import PLOT
from graspq.report.curves import calibration_charts, learning_curves
from graspq.report.film_strips import film_groups
from graspq.report.findings import Findings, RunData, Score, gather
from graspq.report.made_with import command_lines, settings_tables, version_rows
from graspq.report.rows import Row, best_of, rows_of
from graspq.report.stability import stability_of
from graspq.report.success import evaluation_row, interval_text, panel_of, percent, set_name

REFERENCE_NAMES = {RANDOM: "Random policy", ORACLE: "Scripted oracle"}
PALETTE = 8  # colours of candidates; the two after them are the references'


def write_report(
    folders: Sequence[Path], out: Path, *, title: str | None = None, baselines: Path | None = None
) -> None:
    """Write a report on the runs, evaluations and sweeps in some folders, atomically.

    Args:
        folders: see `findings.gather`.
        out: the HTML file.
        title: heading; a sentence on the best result by default.
        baselines: where else to look for evaluations of the random policy and the oracle.

    Raises:
        UserError: a folder holds nothing to report on, or the page cannot be written.
    """
    page = render(gather(folders, baselines), title)
    try:
        write_text(out, page)
    except OSError as error:
        raise UserError(f"{out}: cannot write the report here ({error.strerror}); choose another --out") from None


def render(findings: Findings, title: str | None = None) -> str:
    """Return the page for what was found."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("graspq.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    colors = _colors(findings)
    first = next(iter(findings.panels.values()), [])
    headline = title or _headline(first, findings.runs)
    return environment.get_template("report.html").render(
        title=f"graspq: {headline}",
        headline=headline,
        lead=_lead(first),
        selection=_selection(findings, first),
        cards=_cards(findings, first),
        panels=[panel_of(key, scores, findings.runs, colors) for key, scores in findings.panels.items()],
        stability=[
            one for one in (stability_of(sweep, colors, PALETTE) for sweep in findings.sweeps) if one is not None
        ],
        curves=learning_curves(findings.runs, colors),
        calibration=calibration_charts(findings, colors),
        films=film_groups(findings),
        evaluations=[
            evaluation_row(score, one)
            for scores in findings.panels.values()
            for score in scores
            for one in score.evaluations
        ],
        settings=settings_tables(findings.runs),
        commands=command_lines(findings),
        versions=version_rows(findings),
        version=graspq.__version__,
        plot=PLOT,
    )


def _colors(findings: Findings) -> dict[str, int]:
    """Return the colour of each run and policy; runs of one row have the same."""
    together = {score.name: row.scores[0].name for row in _rows(findings) for score in row.scores}
    names = [run.name for run in findings.runs]
    names += [score.name for row in _rows(findings) if not row.is_reference for score in row.scores]
    firsts = list(dict.fromkeys(together.get(name, name) for name in names))
    return {name: firsts.index(together.get(name, name)) % PALETTE for name in names}


def _rows(findings: Findings) -> list[Row]:
    return [row for scores in findings.panels.values() for row in rows_of(scores)]


def _reference(scores: Sequence[Score], policy: str) -> Score | None:
    return next((score for score in scores if score.policy == policy), None)


def _headline(scores: Sequence[Score], runs: Sequence[RunData]) -> str:
    best = best_of(rows_of(scores))
    if best is not None:
        seen = best.scores[0].evaluations[0].summary["split"] == "train"
        objects = f"{'training' if seen else 'unseen'} objects"
        return f"{best.name} succeeds in {percent(best.rate.value)} of grasps of {objects}"
    if runs:
        return f"Training of {', '.join(run.name for run in runs[:4])}" + (" and others" if len(runs) > 4 else "")
    return "Evaluation of the baselines"


def _lead(scores: Sequence[Score]) -> str:
    if not scores:
        return (
            "Vision-based grasping in simulation with off-policy Q-function estimators. No policy has been scored yet."
        )
    summary = scores[0].evaluations[0].summary
    sentence = (
        f"The {summary['task']} grasping task on the {summary['split']} split of the {set_name(summary)} object set."
    )
    random, oracle = _reference(scores, RANDOM), _reference(scores, ORACLE)
    if random is not None:
        sentence += f" The random policy, which collected the data, succeeds in {percent(random.rate)}"
        sentence += (
            f"; the scripted oracle, which knows poses and meshes, in {percent(oracle.rate)}." if oracle else "."
        )
    elif oracle is not None:
        sentence += f" The scripted oracle, which knows poses and meshes, succeeds in {percent(oracle.rate)}."
    return sentence


def _selection(findings: Findings, scores: Sequence[Score]) -> str:
    """Return on which split the best was selected, and from how many; empty where there was nothing to choose."""
    rows = rows_of(scores)
    best, candidates = best_of(rows), [row for row in rows if not row.is_reference]
    evaluations = (one for row in candidates for score in row.scores for one in score.evaluations)
    places = {parent for one in evaluations for parent in one.folder.resolve().parents}
    tried = sum(len(sweep.rows) for sweep in findings.sweeps if sweep.folder.resolve() in places)
    if best is None or (len(candidates) < 2 and tried < 2):
        return ""
    split = best.scores[0].evaluations[0].summary["split"]
    swept = f", among them the best of {counted(tried, 'job')} of a sweep" if tried else ""
    return (
        f"Best of {counted(len(candidates), 'candidate')}{swept}: selected by success on these very scenes of the "
        f"{split} split, so its rate and interval are flattered. A claim on unseen objects needs a selection on others."
    )


def _cards(findings: Findings, scores: Sequence[Score]) -> list[dict[str, str]]:
    rows, cards = rows_of(scores), []
    best = best_of(rows)
    for row in [best, *(row for row in rows if row.is_reference)]:
        if row is not None:
            name = REFERENCE_NAMES.get(row.scores[0].policy or "", row.name)
            detail = f"95 %: {interval_text(row.rate.low, row.rate.high)}"
            detail += f", {counted(len(row.scores), 'training seed')}" if row.several else ""
            cards.append({"name": name, "number": percent(row.rate.value), "detail": detail})
    episodes = sum(int(one.summary["episodes"]) for one in findings.evaluations)
    if episodes > 0:
        cards.append({"name": "Episodes scored", "number": f"{episodes:,}", "detail": "grasps in simulation"})
    if findings.runs:
        steps = max((row.get("step", 0) for run in findings.runs for row in run.metrics), default=0)
        cards.append(
            {"name": "Runs", "number": f"{len(findings.runs)}", "detail": f"of up to {steps:,} training steps"}
        )
    return cards
