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

import click

from graspq.benchmarks.harness import COLUMNS, Ratio, Row, alone, table
from graspq.common.errors import UserError
from graspq.common.files import read_json, write_json, write_text
from graspq.common.machine import available_cores
from graspq.common.options import Command, Settings, options_from, setting
from graspq.common.text import markdown

BEGIN, END = "<!-- made by benchmarks/bench.py -->", "<!-- end -->"
# A script with its options. {shards} and {run} stand for the options of this command, {work} for a folder of the part.
PARTS = {
    "collection": "collection",
    "frame": "frame",
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
    part: tuple[str, ...] = setting((), help=f"Measure these anew: {', '.join(PARTS)}. Default: all not in --work.")
    work: Path = setting(Path("runs/bench"), help="Folder of the parts' figures.")
    out: Path = setting(Path("results/bench.json"), help="All figures.")
    page: Path = setting(Path("RESULTS.md"), help="Page for the table.")

    def __post_init__(self) -> None:
        """Refuse unknown names of parts (`UserError`)."""
        super().__post_init__()
        for name in set(self.part) - set(PARTS):
            raise UserError(f"{name!r} is no part of the benchmarks; choose from {', '.join(PARTS)}")


def run_script(script: str, *words: str) -> Row:
    """Return what a benchmark's command finds, run in this process."""
    main: click.Command = importlib.import_module(f"graspq.benchmarks.{script}").main
    found: Row = main.invoke(main.make_context(script, list(words)))
    return found


def page_section(found: Mapping[str, Row], commands: Mapping[str, str], facts: str) -> str:
    """Return what the page shows: the ratios, each part's first with its command, and where the time goes."""
    rows: list[list[str]] = []
    for name, part in found.items():
        lines = [Ratio(**ratio).row() for ratio in part["ratios"]]
        rows += [[*line, f"`{commands[name]}`" if line is lines[0] else ""] for line in lines]
    text = markdown((*COLUMNS, "command"), rows) + f"\n{facts}\n"
    for part in found.values():
        for title, shown in part["tables"].items():
            text += f"\n### {title}\n\n{table(shown)}" if title in PUBLISHED_TABLES else ""
    return text


def with_section(text: str, between: str) -> str:
    """Return a page with what stands between its two marks replaced; `UserError` where they are not there."""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise UserError(f"the page for the table lacks the lines {BEGIN} and {END}")
    return f"{before}{BEGIN}\n\n{between}\n{END}{after}"


def write_page(page: Path, out: Path) -> None:
    """Write the table of a page from the stored figures."""
    stored = read_json(out, "benchmarks' figures")
    facts = f"{stored['machine']}. Every figure, with the day and the code of each part: [{out}]({out})."
    write_text(page, with_section(page.read_text(), page_section(stored["parts"], stored["commands"], facts)))


def machine() -> str:
    """Return the processor's name, as far as the system tells, and the number of cores."""
    described = Path("/proc/cpuinfo")
    found = re.search(r"(?m)^model name\s*:\s*(.+)$", described.read_text() if described.is_file() else "")
    return f"{found[1] if found else 'unknown processor'}, {available_cores()} cores"


@click.command(cls=Command)
@options_from(BenchSettings)
def main(settings: BenchSettings) -> None:
    """Run the benchmarks that are asked for or not done yet; write their figures and the table of ratios."""
    settings.work.mkdir(parents=True, exist_ok=True)
    stored = read_json(settings.out, "benchmarks' figures") if settings.out.exists() else {"parts": {}, "commands": {}}
    found: dict[str, Row] = {}
    commands: dict[str, str] = {}
    for name, template in PARTS.items():
        work, path = settings.work / name, settings.work / f"{name}.json"
        script, *words = template.format(shards=settings.shards, run=settings.run, work=work.as_posix()).split()
        if settings.part and name not in settings.part:
            if name in stored["parts"]:
                found[name], commands[name] = stored["parts"][name], stored["commands"][name]
            continue
        commands[name] = " ".join([f"python benchmarks/{script}.py", *words])
        if settings.part:
            shutil.rmtree(work, ignore_errors=True)  # what it would go on from
        if settings.part or not path.exists():
            click.echo(f"\n== {name}: {commands[name]}", err=True)
            write_json(path, alone(run_script, script, *words))
        found[name] = read_json(path, "benchmark's figures")
    write_json(settings.out, {"machine": machine(), "commands": commands, "parts": found})
    write_page(settings.page, settings.out)


if __name__ == "__main__":
    main()
