"""All benchmarks, one after the other: `results/bench.json` and the table of ratios in `RESULTS.md`.

    make bench

Each part is a script of this folder in a process of its own, which runs its rivals itself. What a part measured is kept
in `--work`: the same command goes on where it was stopped, and `--again PART` measures one anew. Nothing else should
run meanwhile; it takes about two hours on 2 cores. Every part says on which day and with which code it was measured.
"""

import dataclasses
import re
import shutil
import subprocess
import sys
from pathlib import Path

import click
from breakdown import section
from ratios import Found, ratio_rows
from timing import table

from graspq.common.errors import UserError
from graspq.common.files import read_json, write_json, write_text
from graspq.common.machine import available_cores
from graspq.common.options import Command

FOLDER = Path(__file__).resolve().parent
BEGIN, END = "<!-- made by benchmarks/bench.py -->", "<!-- end -->"


@dataclasses.dataclass(frozen=True)
class Part:
    """A script and its arguments.

    Attributes:
        script: its name without `.py`.
        arguments: `{shards}` and `{run}` stand for the options of this command, `{own}` for a folder of the part.
    """

    script: str
    arguments: tuple[str, ...] = ()

    def words(self, **given: str) -> list[str]:
        """Return the command's words after `python`, without `--out`."""
        return [f"benchmarks/{self.script}.py", *(word.format(**given) for word in self.arguments)]


PARTS = {
    "collection": Part("collection", ("--part", "pace", "--part", "profile", "--part", "scaling")),
    "worker_memory": Part("collection", ("--part", "memory", "--scenes", "10000")),
    "loading": Part("loading", ("--shards", "{shards}", "--part", "speed", "--part", "waiting")),
    "streaming_memory": Part("loading", ("--shards", "{shards}", "--part", "memory")),
    "training": Part("training", ("--shards", "{shards}")),
    "estimators": Part("estimators", ("--shards", "{shards}")),
    "roofline": Part("roofline", ("--shards", "{shards}")),
    "decision": Part("decision"),
    "evaluation": Part("evaluation", ("{run}", "--episodes", "512", "--rival-episodes", "128")),
    "time_to_quality": Part("time_to_quality", ("--shards", "{shards}", "--seeds", "3", "--work", "{own}")),
}


def with_section(text: str, between: str) -> str:
    """Return a page with what stands between its two marks replaced.

    Raises:
        UserError: the marks are not there.
    """
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise UserError(f"the page for the table lacks the lines {BEGIN} and {END}")
    return f"{before}{BEGIN}\n\n{between}\n\n{END}{after}"


def measured(name: str, words: list[str], work: Path, again: bool) -> Found:
    """Return what a part wrote, after running it if that is not there yet.

    Raises:
        UserError: it failed.
    """
    path = work / f"{name}.json"
    if again or not path.exists():
        if again:
            shutil.rmtree(work / name, ignore_errors=True)  # what it went on from
        click.echo(f"\n== {name}: python {' '.join(words)}", err=True)
        fresh = work / f"{name}.fresh.json"
        done = subprocess.run(
            [sys.executable, str(FOLDER.parent / words[0]), *words[1:], "--out", str(fresh)], check=False
        )
        if done.returncode != 0:
            raise UserError(f"{name}: ended with status {done.returncode}; its words are above, nothing of it was kept")
        fresh.replace(path)
    result: Found = read_json(path, "benchmark's figures")
    return result


def processor() -> str:
    """Return the processor's name, as far as the system tells."""
    try:
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        found = None
    return found[1] if found else "unknown processor"


@click.command(cls=Command)
@click.option("--shards", default="data/regular-10k", show_default=True, help="Dataset folder.")
@click.option("--run", default="runs/mc-regular-10k-seed0", show_default=True, help="Run that is evaluated.")
@click.option(
    "--work",
    type=click.Path(path_type=Path),
    default=Path("runs/bench"),
    show_default=True,
    help="Folder of the parts' figures.",
)
@click.option(
    "--part", "parts", type=click.Choice(list(PARTS)), multiple=True, help="What to measure; all if not given."
)
@click.option("--again", type=click.Choice(list(PARTS)), multiple=True, help="Measure this part anew; may be repeated.")
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("results/bench.json"), show_default=True, help="All figures."
)
@click.option(
    "--page",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    default=Path("RESULTS.md"),
    show_default=True,
    help="Page for the table.",
)
def main(
    shards: str, run: str, work: Path, parts: tuple[str, ...], again: tuple[str, ...], out: Path, page: Path
) -> None:
    """Run the benchmarks that are not done yet, and write their figures and the table of ratios."""
    work.mkdir(parents=True, exist_ok=True)
    found: dict[str, Found] = {}
    commands: dict[str, str] = {}
    for name, part in PARTS.items():
        words = part.words(shards=shards, run=run, own=(work / name).as_posix())
        commands[name] = f"python {' '.join(words)}"
        if not parts or name in (*parts, *again) or (work / f"{name}.json").exists():
            found[name] = measured(name, words, work, name in again)
    lines = table(ratio_rows(found, commands))
    facts = {"processor": processor(), "cores": available_cores()}
    write_json(out, {**facts, "commands": commands, "parts": found})
    where = (
        f"{facts['processor']}, {facts['cores']} cores. Every figure, with the day and the code of each part: "
        f"[{out}]({out})."
    )
    write_text(page, with_section(page.read_text(), "\n\n".join(filter(None, [lines, where, section(found)]))))
    click.echo(lines)


if __name__ == "__main__":
    main()
