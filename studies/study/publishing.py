"""What a study shows: its section of RESULTS.md, with tables of rows, differences and claims, and its figures."""

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from graspq.common.errors import UserError
from graspq.common.files import write_text
from graspq.common.text import markdown, write_jsonl
from graspq.evaluate.choosing import ScoredCheckpoint, choosing
from graspq.evaluate.results_table import outcomes_of
from graspq.evaluate.statistics import SeveralRuns, mean_success
from graspq.studies.study.claims import judged
from graspq.studies.study.comparisons import (
    Compared,
    Place,
    Scored,
    against,
    asked_rows,
    difference_text,
    objects_in_scenes,
    p_text,
    reference_row,
    scored_rows,
    trainings,
    unequal_steps,
)
from graspq.studies.study.figures import write_figures

Table = Sequence[Mapping[str, Any]]
Rows = Mapping[Place, Mapping[str, Scored]]


def publish(
    study: str,
    plan: Path,
    table: Table,
    beside: Table,
    results: Path,
    page: Path | None,
    reference: str | None = None,
) -> list[Path]:
    """Write the scores, the figures and the section of a page; return what was written.

    Args:
        study: name of the study.
        plan: its file, for the command that makes it again.
        table: its scores, as `read_scores` gives them.
        beside: scores of other studies, that claims are judged by too.
        results: folder of scores and figures.
        page: the page, which is made or gets the section at its end where it has none yet; None for none.
        reference: name of the row that differences are to; the best where it is None.

    Raises:
        UserError: no run is scored yet, or what stands beside cannot be judged together, see `asked_rows`; nothing was
            written then.
    """
    rows = scored_rows(table)
    asked_rows([*table, *beside])
    if not rows:
        raise UserError(f"{study}: no run is scored yet; run: grasp-study run {plan}")
    scores = results / f"study-{study}.jsonl"
    write_jsonl(scores, table)
    figures = write_figures(study, rows, trainings(table), references(table), results / "figures")
    written = [scores, *figures]
    if page is not None:
        files = [Path(os.path.relpath(path, page.parent)) for path in (scores, *figures)]
        text = section(study, plan, table, beside, files, reference)
        write_text(page, with_section(page.read_text(encoding="utf-8") if page.exists() else "", study, text))
        written.append(page)
    return written


def with_section(text: str, study: str, section: str) -> str:
    """Return a page with what stands between the marks of a study replaced, or with marks and section at its end."""
    begin, end = f"<!-- made by grasp-study, {study} -->", f"<!-- end of {study} -->"
    made = f"{begin}\n\n{section}\n{end}"
    before, found, rest = text.partition(begin)
    if not found:
        return f"{text.rstrip()}\n\n{made}\n".lstrip()
    return before + made + rest.partition(end)[2]


def section(
    study: str, plan: Path, table: Table, beside: Table, files: Sequence[Path], reference: str | None = None
) -> str:
    """Return the section of a study in Markdown: facts, the table of rows, figures, claims."""
    rows = scored_rows(table)
    scores, *figures = files
    parts = [f"## Study {study}\n", facts(plan, table, scores, rows), row_table(rows, table, reference)]
    parts += [f"![Success by row of study {study}]({path.as_posix()})\n" for path in figures]
    found = choosing_table(rows)
    if found:
        parts += ["### Choosing without a simulator\n", found]
    if any(unequal_steps(here) for here in rows.values()):
        parts.append(
            "No row is tested against another, and no claim is judged: these are the paper's settings with unequal "
            "numbers of steps.\n"
        )
    else:
        parts += ["### The claims of the paper\n", claim_table([*table, *beside])]
    return "\n".join(parts)


def facts(plan: Path, table: Table, scores: Path, rows: Rows) -> str:
    """Return the sentences that a table cannot be read without."""
    runs = [one for one in table if one["kind"] == "run"]
    done = [one for one in runs if one["status"] == "done"]
    frozen = all(one["recipe_frozen"] for one in done)
    recipe = "of a frozen recipe" if frozen else "of a recipe that is not frozen"
    splits = sorted({str(one["split"]) for one in done})
    code = sorted({str(one.get("trained_by"))[:8] for one in done} | {str(one.get("scored_by"))[:8] for one in done})
    data = sorted({str(one.get("data_sha256"))[:12] for one in done})
    objects = sorted({str(one["object_set_sha256"])[:12] for one in done})
    scored = [row for here in rows.values() for row in here.values()]
    things = "scenes and objects" if all(row.counts is not None for row in scored) else "scenes of these objects"
    over = f"new training seeds, {things} with this one dataset"
    if not any(row.several for row in scored):
        over = f"new {things}, for the one training of each row (another may lie as far off again)"
    elif not all(row.several for row in scored):
        over += " (of a row with one training: for that one)"
    chosen = " Choices are made on such scores, which flatters what was chosen."
    if all(one.startswith("test") for one in splits):
        chosen = ""
    return (
        f"`grasp-study run {plan.as_posix()}`: {len(done)} of {len(runs)} trainings, {recipe}, scored on "
        f"`{'`, `'.join(splits)}`.{chosen} Intervals are 95 %, over {over}; every "
        f"policy met the same scenes. Data {', '.join(data)}, objects {', '.join(objects)}, code {', '.join(code)}; "
        f"outcome of every grasp: [{scores.as_posix()}]({scores.as_posix()}).\n"
    )


def references(table: Table) -> dict[str, list[Mapping[str, Any]]]:
    """Return the scores of policies without a run by task."""
    found: dict[str, list[Mapping[str, Any]]] = {}
    for one in table:
        if one["kind"] == "reference":
            found.setdefault(one["task"], []).append(one)
    return found


def row_table(rows: Rows, table: Table, reference: str | None = None) -> str:
    """Return the table by task, size and row, with each row's difference to the best or to `reference`.

    The best comes first, rows of which a training failed come last. Of a row with one training a difference has no
    interval, and one that lacks a training no p-value.
    """
    lines = []
    beside, told = references(table), set[str]()
    for place, here in rows.items():
        compared = {} if unequal_steps(here) else against(here, reference)
        one = None if unequal_steps(here) else reference_row(here, reference)
        for row in sorted(here.values(), key=lambda row: (bool(row.failures), -row.mean.value)):
            lines.append(_row(place, row, one, compared.get(row.name)))
        for policy in beside.get(place.task, []) if place.task not in told else []:
            mean = reference_mean(policy, table)
            lines.append([policy["policy"], place.task, "", f"{mean.value:.3f}", _interval(mean), *[""] * 6])
        told.add(place.task)
    heads = [
        "row",
        "task",
        "grasps",
        "success",
        "95 % interval",
        "each seed",
        f"less {reference or 'the best'}",
        "p (Holm)",
    ]
    text = markdown([*heads, "discount", "steps", "recipe"], lines)
    every = [(place, row) for place, here in asked_rows(table).items() for row in here.values()]
    failed = [
        f"`{row.name}` ({place}): {row.lacking}" + "".join(f"; {one}" for one in row.failures)
        for place, row in every
        if row.failures
    ]
    unbegun = sorted({row.name for _, row in every} - {row.name for _, row in every if row.rows or row.failures})
    text += "\nFailed: " + ". ".join(failed) + ".\n" if failed else ""
    return text + ("\nNot run: " + ", ".join(f"`{name}`" for name in unbegun) + ".\n" if unbegun else "")


def reference_mean(line: Mapping[str, Any], table: Table) -> SeveralRuns:
    """Return the mean success of a policy without a run, with its interval over new scenes and objects.

    Args:
        line: of the table of scores, of kind `reference`.
        table: all of it.
    """
    counts = objects_in_scenes(table).get((line["task"], line["split"], line["episodes"]))
    return mean_success(outcomes_of(dict(line))[None], counts)


def _interval(mean: SeveralRuns) -> str:
    return f"{mean.low:.3f} to {mean.high:.3f}"


def _row(place: Place, row: Scored, reference: Scored | None, compared: Compared | None) -> list[str]:
    mean, first = row.mean, row.rows[0]
    difference = ""
    if reference is not None and reference is not row:
        found = compared.difference if compared is not None else row.less(reference)
        difference = difference_text(found) if row.several and reference.several else f"{found.value:+.3f}"
    p = p_text(compared.p_value) if compared is not None else ""
    size = place.size if place.setting == "off-policy" else f"{place.size}, {place.setting}"
    discount = first.get("discount")
    name = f"`{row.name}`" + (f" ({row.lacking})" if row.lacking else "")
    return [
        name, place.task, size, f"{mean.value:.3f}", _interval(mean),
        " ".join(f"{rate:.3f}" for rate in row.rates), difference, p,
        f"{discount:g}" if discount is not None else "", f"{first['steps']:,}", f"`{first['recipe_sha256'][:8]}`",
    ]  # fmt: skip


def choosing_table(rows: Rows) -> str:
    """Return how well held-back measures order the runs of a place, and of an estimator there; empty without any."""
    lines = []
    for place, here in rows.items():
        runs = [
            ScoredCheckpoint(row.algo, one["validation"], float(one["success_rate"]))
            for row in here.values()
            for one in row.rows
            if one.get("validation")
        ]
        lines += [
            [
                one.words,
                str(place),
                _rho(one.within),
                _rho(one.correlation),
                by_chance(one.checkpoints),
                str(one.checkpoints),
            ]
            for one in choosing(runs)
        ]
    heads = [
        "held-back measure",
        "at",
        "Spearman's ρ with success within an estimator",
        "over all",
        "by chance",
        "runs",
    ]
    return markdown(heads, lines) if lines else ""


def by_chance(count: int) -> str:
    """Return between what a rank correlation of so many runs lies 19 times in 20 where there is no relation."""
    return f"±{min(1.96 / math.sqrt(count - 1), 1.0):.2f}"


def _rho(correlation: float | None) -> str:
    return f"{correlation:+.2f}" if correlation is not None else ""


def claim_table(table: Table) -> str:
    """Return the table of the paper's claims."""
    lines = [[one.claim, f"**{one.verdict}**", one.test, one.seen] for one in judged(table)]
    return markdown(["claim of the paper", "verdict", "test", "what was seen"], lines)
