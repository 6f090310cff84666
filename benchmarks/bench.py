"""All benchmarks, one after the other (`make bench`): `results/bench.json` and the table of ratios in `RESULTS.md`.

Each part is a script of this folder, run in a process of its own; docs/benchmarks.md says what each compares. What a
part measured is kept in `--work`. Nothing else should run meanwhile; it takes about two hours on 2 cores.
"""

import importlib
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from graspq.benchmarks.measuring import Call, Ratio, apart, table
from graspq.common.errors import UserError
from graspq.common.files import read_json, write_json, write_text
from graspq.common.machine import available_cores
from graspq.common.options import Command, Settings, options_from, setting
from graspq.common.text import markdown

BEGIN, END = "<!-- made by benchmarks/bench.py -->", "<!-- end -->"
# {shards} and {run} stand for the options of this command, {work} for a folder of the part.
PARTS = {
    "collection": "collection",
    "worker_memory": "worker_memory --scenes 10000",
    "loading": "loading --shards {shards}",
    "streaming": "streaming --shards {shards}",
    "training": "training --shards {shards}",
    "estimators": "estimators --shards {shards}",
    "decision": "decision",
    "evaluation": "evaluation_speed {run} --episodes 512 --rival-episodes 128",
    "time_to_quality": "time_to_quality --shards {shards} --seeds 3 --work {work}",
}
PUBLISHED_TABLES = ("Where a grasp's time goes", "Where a training step's time goes")


@dataclass(frozen=True)
class BenchSettings(Settings):
    """Settings of this command."""

    shards: str = setting("data/regular-10k", help="Dataset folder.")
    run: str = setting("runs/mc-regular-10k-seed0", help="Run that is evaluated.")
    part: tuple[str, ...] = setting((), help=f"What to measure: {', '.join(PARTS)}. Default: all.")
    again: tuple[str, ...] = setting((), help="Measure this part anew; may be repeated.")
    work: Path = setting(Path("runs/bench"), help="Folder of the parts' figures.")
    out: Path = setting(Path("results/bench.json"), help="All figures.")
    page: Path = setting(Path("RESULTS.md"), help="Page for the table.")

    def __post_init__(self) -> None:
        """Check the names of parts.

        Raises:
            UserError: one is unknown.
        """
        super().__post_init__()
        for name in {*self.part, *self.again} - set(PARTS):
            raise UserError(f"{name!r} is no part of the benchmarks; choose from {', '.join(PARTS)}")


def run_script(script: str, words: list[str]) -> None:
    """Run a benchmark's command in this process.

    Raises:
        UserError: it failed.
    """
    try:
        importlib.import_module(f"graspq.benchmarks.{script}").main.main(words, prog_name=script)
    except SystemExit as ended:
        if ended.code:
            raise UserError(f"{script}: ended with status {ended.code}; its words are above, nothing is kept") from None


def measured(name: str, words: list[str], work: Path, again: bool) -> dict[str, Any]:
    """Return what a part found, after running it if that is not there yet."""
    path, fresh = work / f"{name}.json", work / f"{name}.fresh.json"
    if again:
        shutil.rmtree(work / name, ignore_errors=True)  # what it went on from
    if again or not path.exists():
        click.echo(f"\n== {name}: python benchmarks/{words[0]}.py {' '.join(words[1:])}", err=True)
        for _ in apart([Call(run_script, (words[0], [*words[1:], "--out", str(fresh)]))]):
            fresh.replace(path)
    found: dict[str, Any] = read_json(path, "benchmark's figures")
    return found


def page_section(found: Mapping[str, Mapping[str, Any]], commands: Mapping[str, str], facts: str) -> str:
    """Return what the page shows: the ratios, each part's first with its command, and where the time goes."""
    rows: list[list[str]] = []
    for name, part in found.items():
        lines = [Ratio(**ratio).row() for ratio in part["ratios"]]
        rows += [[*line, f"`{commands[name]}`" if line is lines[0] else ""] for line in lines]
    text = markdown(("in one run", "measured", "bar", "aim", "met", "command"), rows) + f"\n{facts}\n"
    for part in found.values():
        for title, shown in part["tables"].items():
            text += f"\n### {title}\n\n{table(shown)}" if title in PUBLISHED_TABLES else ""
    return text


def with_section(text: str, between: str) -> str:
    """Return a page with what stands between its two marks replaced.

    Raises:
        UserError: the marks are not there.
    """
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise UserError(f"the page for the table lacks the lines {BEGIN} and {END}")
    return f"{before}{BEGIN}\n\n{between}\n{END}{after}"


def processor() -> str:
    """Return the processor's name, as far as the system tells."""
    try:
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        found = None
    return found[1] if found else "unknown processor"


@click.command(cls=Command)
@options_from(BenchSettings)
def main(settings: BenchSettings) -> None:
    """Run the benchmarks that are not done yet, and write their figures and the table of ratios."""
    settings.work.mkdir(parents=True, exist_ok=True)
    published = read_json(settings.out, "benchmarks' figures") if settings.out.exists() else {"parts": {}}
    found: dict[str, dict[str, Any]] = {}
    commands: dict[str, str] = {}
    for name, template in PARTS.items():
        work = (settings.work / name).as_posix()
        words = template.format(shards=settings.shards, run=settings.run, work=work).split()
        commands[name] = f"python benchmarks/{words[0]}.py {' '.join(words[1:])}".strip()
        if name in (settings.part or PARTS) or name in settings.again:
            found[name] = measured(name, words, settings.work, name in settings.again)
        elif name in published["parts"]:
            found[name], commands[name] = published["parts"][name], published["commands"][name]
    where = f"{processor()}, {available_cores()} cores"
    write_json(settings.out, {"machine": where, "commands": commands, "parts": found})
    facts = f"{where}. Every figure, with the day and the code of each part: [{settings.out}]({settings.out})."
    write_text(settings.page, with_section(settings.page.read_text(), page_section(found, commands, facts)))


if __name__ == "__main__":
    main()
