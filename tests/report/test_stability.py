"""Sweeps in the report: the figure of stability, and pages that stay readable with many runs."""

import json
import shutil
from pathlib import Path

import pytest

from graspq.common.errors import UserError
from graspq.evaluate.records import FORMAT_VERSION, write_summary
from graspq.report.charts import PLOT
from graspq.report.findings import gather
from graspq.report.page import render
from graspq.report.stability import Sweep, find_sweeps, stability_chart, stability_of

RATES = {"dql": [0.25, 0.75, None, 0.5], "mc": [0.5, "to do"]}


@pytest.fixture
def sweep(tmp_path: Path) -> Sweep:
    """Four jobs of dql, one of them failed, and two of mc, one of them to do."""
    rows = []
    for algo, rates in RATES.items():
        for index, rate in enumerate(rates):
            status = "failed" if rate is None else "to do" if rate == "to do" else "done"
            known = rate if status == "done" else None
            rows.append({"id": f"{algo}-{index}", "algo": algo, "status": status, "steps": 9, "success_rate": known})
    folder = tmp_path / "sweep"
    folder.mkdir()
    (folder / "sweep.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (found,) = find_sweeps(tmp_path)
    return found


def test_runs_are_sorted_by_success_and_one_that_failed_stands_at_zero(sweep: Sweep) -> None:
    assert {algo: sweep.rates(algo) for algo in sweep.estimators} == {"dql": [0.75, 0.5, 0.25, 0.0], "mc": [0.5]}


def test_the_figure_is_success_over_rank_for_each_estimator(sweep: Sweep) -> None:
    chart = stability_chart(sweep, {}, 8)
    assert chart is not None
    dql, mc = chart.series
    assert ([dql.name, mc.name], [dql.color, mc.color]) == (["dql", "mc"], [0, 1])
    width, height = PLOT["right"] - PLOT["left"], PLOT["bottom"] - PLOT["top"]
    expected = [
        (PLOT["left"] + width * (rank - 0.5) / 6, PLOT["bottom"] - height * rate)
        for rank, rate in enumerate((0.75, 0.5, 0.25, 0.0), start=1)
    ]
    assert [dot[:2] for dot in dql.dots] == [pytest.approx(point, abs=0.051) for point in expected]
    assert [label for _, label in chart.x_ticks] == ["2", "4", "6"]
    assert "dql: 0.75, 0.50, 0.25, 0.00; mc: 0.50." in chart.description


def test_an_estimator_has_the_colour_that_its_best_run_has_elsewhere_on_the_page(sweep: Sweep) -> None:
    chart = stability_chart(sweep, {"dql-1": 5, "dql-0": 3, "mc-0": 0}, 8)
    assert chart is not None and [one.color for one in chart.series] == [5, 0]


def test_numbers_beside_the_figure(sweep: Sweep) -> None:
    found = stability_of(sweep, {}, 8)
    assert found is not None
    assert (found["finished"], found["jobs"]) == (5, 6)
    assert found["rows"][0] == {
        "algo": "dql", "runs": 4, "failed": 1, "best": "0.750", "median": "0.375", "worst": "0.000", "best_id": "dql-1",
    }  # fmt: skip


def test_a_sweep_without_a_finished_job_has_no_figure_yet(sweep: Sweep) -> None:
    rows = [row | {"status": "to do", "success_rate": None} for row in sweep.rows]
    assert stability_of(Sweep(sweep.folder, rows), {}, 8) is None


def test_a_page_on_a_sweep_shows_the_figure_and_of_its_runs_the_best_of_each_estimator(
    sweep: Sweep, run_folder: Path, tmp_path: Path
) -> None:
    for row in sweep.rows:
        shutil.copytree(run_folder, sweep.folder / "runs" / row["id"])
    shutil.copytree(run_folder, tmp_path / "beside")
    findings = gather([sweep.folder, tmp_path / "beside"], None)
    assert [run.name for run in findings.runs] == ["dql-1", "mc-0", "beside"]
    page = render(findings)
    assert '<section id="stability">' in page and "5 of 6 jobs finished" in page
    assert "sweep: success of every run, sorted" in page
    assert '<section id="stability">' not in render(gather([run_folder], None))


def test_a_page_says_that_its_best_was_selected_among_the_jobs_of_a_sweep(sweep: Sweep, tmp_path: Path) -> None:
    job = sweep.folder / "runs" / "dql-1" / "evaluations" / "e"
    other = tmp_path / "other"
    for folder in (job, other):
        folder.mkdir(parents=True)
        write_summary(
            folder,
            {
                "format_version": FORMAT_VERSION, "label": folder.name, "task": "regular", "split": "validation",
                "episodes": 4, "successes": 3, "success_rate": 0.75, "ci95": [0.3, 0.95], "mean_steps": 4.0,
                "policy": "cem", "seed": 0, "job": {},
            },
        )  # fmt: skip
    assert "selected by" not in render(gather([other], None))
    assert "among them the best of 6 jobs of a sweep: selected by success on these very scenes of the validation" in (
        render(gather([sweep.folder], None))
    )


def test_a_table_that_is_none_is_refused(tmp_path: Path) -> None:
    (tmp_path / "sweep.jsonl").write_text('{"id": "x"}\n')
    with pytest.raises(UserError, match=r"sweep\.jsonl: not the table of a sweep"):
        find_sweeps(tmp_path)
