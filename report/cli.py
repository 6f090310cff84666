"""`grasp-report`: one HTML page on runs and their evaluations, to look at and to send to others.

The way on: `page` -> `findings` (what was found) and `charts` (geometry) -> `templates/report.html`.
"""

from dataclasses import dataclass
from pathlib import Path

import click

from graspq.common.options import Command, Settings, options_from, setting, with_version


@dataclass(frozen=True)
class ReportSettings(Settings):
    """Settings of `grasp-report`; see each field's help."""

    folders: tuple[Path, ...] = setting(
        help="Runs, evaluations, sweeps, or folders that hold some.", positional=True, metavar="FOLDER..."
    )
    out: Path = setting(Path("report.html"), help="The HTML file to write.")
    baselines: Path | None = setting(
        Path("runs/baselines"),
        help="Where to look for evaluations of the random policy, the oracle and users' policies as well.",
    )
    title: str | None = setting(None, help="Heading of the page. Default: its best result.")


@click.command(cls=Command, name="grasp-report")
@with_version
@options_from(ReportSettings)
def main(settings: ReportSettings) -> None:
    """Write one self-contained HTML page on runs and evaluations.

    It shows success with intervals, learning curves, calibration, film strips and settings, and of a sweep every run's
    success, sorted; it needs no network, and can be mailed or put on a web server as it is.

    \b
    Examples:
      grasp-report runs/mc runs/dql --out report.html
      grasp-report runs/quickstart --out runs/quickstart/report.html
      grasp-report runs/sweep-small --out sweep.html
    """
    from graspq.report.page import write_report

    write_report(settings.folders, settings.out, title=settings.title, baselines=settings.baselines)
    click.echo(f"report: {settings.out}")
