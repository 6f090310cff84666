"""Sweeps in a report: how stable each estimator is over the settings and seeds that `grasp-sweep` tried."""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graspq.evaluate.sweep_table import SWEEP_FILE, read_sweep_table
from graspq.report.charts import LineChart, Series, line_chart

MOST_DOTS = 40  # more runs than these are a line alone
FEWEST_RANKS = 6  # so that ticks are whole ranks


@dataclass(frozen=True)
class Sweep:
    """A sweep as its table tells it.

    Attributes:
        folder: the sweep's folder, which holds a run for each row in `runs/<id>`.
        rows: the rows of the table.
    """

    folder: Path
    rows: list[dict[str, Any]]

    @property
    def estimators(self) -> list[str]:
        """Return the estimators, in the order of the table."""
        return list(dict.fromkeys(str(row["algo"]) for row in self.rows))

    def rates(self, algo: str) -> list[float]:
        """Return the success rates of an estimator's finished jobs, best first; one that failed counts as 0."""
        rows = [row for row in self.rows if row["algo"] == algo and row["status"] in ("done", "failed")]
        return sorted((float(row["success_rate"] or 0.0) for row in rows), reverse=True)

    def failed(self, algo: str) -> int:
        """Return how many jobs of an estimator failed."""
        return sum(row["algo"] == algo and row["status"] == "failed" for row in self.rows)

    def best(self, algo: str) -> dict[str, Any]:
        """Return the row of an estimator's best job, or of the one that is furthest where none was scored."""
        rows = [row for row in self.rows if row["algo"] == algo]
        return max(rows, key=lambda row: (-1.0 if row["success_rate"] is None else row["success_rate"], row["steps"]))

    def left_out(self) -> set[Path]:
        """Return the run folders that a report's other sections leave out: all but the best of each estimator."""
        best = {self.best(algo)["id"] for algo in self.estimators}
        return {(self.folder / "runs" / row["id"]).resolve() for row in self.rows if row["id"] not in best}


def find_sweeps(folder: Path) -> list[Sweep]:
    """Return the sweeps at and below a folder, in the order of their paths.

    Raises:
        UserError: a table is not one of grasp-sweep.
    """
    return [Sweep(path.parent, read_sweep_table(path)) for path in sorted(folder.rglob(SWEEP_FILE))]


def stability_of(sweep: Sweep, colors: Mapping[str, int], palette: int) -> dict[str, Any] | None:
    """Return a sweep's figure and its rows of numbers; None before its first job is finished.

    Args:
        sweep: the sweep.
        colors: of the runs that the page shows, by name: an estimator has that of its best run.
        palette: number of colours of the page.
    """
    chart = stability_chart(sweep, colors, palette)
    if chart is None:
        return None
    finished = sum(len(sweep.rates(algo)) for algo in sweep.estimators)
    rows = [_row(sweep, algo) for algo in sweep.estimators if sweep.rates(algo)]
    return {"chart": chart, "rows": rows, "finished": finished, "jobs": len(sweep.rows)}


def stability_chart(sweep: Sweep, colors: Mapping[str, int], palette: int) -> LineChart | None:
    """Return success over rank: for each estimator all its finished jobs, sorted by success, best first.

    See `stability_of` for the arguments.

    Source: Quillen et al. 2018, figure on hyperparameter sensitivity in section "Analyzing Stability".
    Differs: 1. A job that failed, such as by diverging, stands at 0; the paper does not say what it does with those.
    """
    curves = [(algo, sweep.rates(algo)) for algo in sweep.estimators]
    most = max((len(rates) for _, rates in curves), default=0)
    series = [
        Series(
            algo,
            colors.get(sweep.best(algo)["id"] if rates else "", index % palette),
            [(float(rank), rate) for rank, rate in enumerate(rates, start=1)],
            dots=[3.5] * len(rates) if most <= MOST_DOTS else (),
        )
        for index, (algo, rates) in enumerate(curves)
    ]
    return line_chart(
        f"{sweep.folder.resolve().name}: success of every run, sorted",
        "; ".join(f"{algo}: {', '.join(f'{rate:.2f}' for rate in rates)}" for algo, rates in curves if rates) + ".",
        series,
        x_label="rank of the run within its estimator",
        y_label="success rate",
        x_range=(0.5, max(most, FEWEST_RANKS) + 0.5),
        y_range=(0.0, 1.0),
    )


def _row(sweep: Sweep, algo: str) -> dict[str, Any]:
    rates = sweep.rates(algo)
    best = sweep.best(algo)
    return {
        "algo": algo,
        "runs": len(rates),
        "failed": sweep.failed(algo),
        "best": f"{rates[0]:.3f}",
        "median": f"{statistics.median(rates):.3f}",
        "worst": f"{rates[-1]:.3f}",
        "best_id": best["id"] if best["success_rate"] is not None else "–",
    }


def all_left_out(sweeps: Sequence[Sweep]) -> set[Path]:
    """Return the run folders that the other sections leave out, over all sweeps."""
    return {folder for sweep in sweeps for folder in sweep.left_out()}
