"""Collection, training and evaluation in a loop for hours, with SIGKILLs at random moments.

    make soak HOURS=3

Every cycle ends in the same bytes as the first, which was left alone; nothing stays behind; and one process that does
the same work again and again keeps its memory and its file handles. Ends in results/soak.json.
"""

import contextlib
import json
import os
import random
import shutil
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from graspq.common.files import write_json
from tests.faults.commands import TRAINING, Running, difference, essence
from tests.faults.harness import HERE, ROOT, Work

LINES = (
    ("grasp-datagen --size 60 --seed 5 --objects objects --out data --workers 1", "data"),
    (f"grasp-train --algo mc --shards data --out run --steps 40 --seed 5 {TRAINING}", "run"),
    ("grasp-eval run --episodes 6 --films 1 --workers 1 --device cpu --out scores", "scores"),
)
LIMIT_SECONDS = 600.0
GROWTH = 1.1  # of the memory of the one process, from the second quarter of its cycles to the last


def soak(hours: float, seed: int = 0) -> int:
    """Go on for so many hours; return 1 where anything was lost or grew.

    Args:
        hours: at least two cycles are done.
        seed: of the moments of the kills.
    """
    started, draws = time.monotonic(), random.Random(seed)
    folder = ROOT / "runs" / "soak"
    shutil.rmtree(folder, ignore_errors=True)
    facts: dict[str, object] = {}
    with Work(folder) as work:
        case = folder / "case"
        shutil.copytree(work.objects, case / "objects")
        usual, took = {}, {}
        for line, result in LINES:
            ran = Running(work, line.split(), case).ended(LIMIT_SECONDS)
            if ran.rc != 0:
                raise SystemExit(f"{line}: {ran.rc}: {ran.line}")
            usual[result], took[line] = essence(case / result), ran.seconds
        cycles = kills = 0
        wrong: list[str] = []
        rows: list[dict[str, int]] = []
        with _steady(work, case) as steady:
            while time.monotonic() - started < 3600 * hours or cycles < 2:
                for _, result in LINES:
                    shutil.rmtree(case / result)
                for line, result in LINES:
                    more, ran_out = _until_done(work, line, case, took[line], draws)
                    kills += more
                    differs = ran_out or difference(essence(case / result), usual[result])
                    wrong += [f"cycle {cycles}, {result}: {differs}"] if differs is not None else []
                left = _left(folder / "temporary")
                wrong += [f"cycle {cycles}: left {left}"] if left else []
                rows.append(_answer(steady))
                cycles += 1
                facts = _facts(started, cycles, kills, wrong, rows)
                write_json(ROOT / "results" / "soak.json", facts)
                print(f"cycle {cycles}: {kills} kills, {len(wrong)} wrong, {rows[-1]}", flush=True)
    print(json.dumps(facts, indent=2))
    return int(bool(facts["wrong"]) or not facts["flat"])


def _until_done(work: Work, line: str, case: Path, took: float, draws: random.Random) -> tuple[int, str | None]:
    """Start a command again and again, and kill it at a random moment, until it was faster; return how many kills."""
    kills = 0
    while True:
        running = Running(work, line.split(), case)
        patience = draws.uniform(0.0, 1.5 * took) if kills < 8 else LIMIT_SECONDS
        with contextlib.suppress(subprocess.TimeoutExpired):
            running.process.wait(patience)
        if running.process.poll() is None:
            kills += 1
            # The whole group as a power cut, or the command alone, whose workers then see for themselves.
            if draws.random() < 0.5:
                running.send(signal.SIGKILL)
            else:
                running.process.kill()
                running.process.wait()
            running.process.stdout.close()
            running.process.stderr.close()
            continue
        ran = running.ended()
        return kills, None if ran.rc == 0 else f"{line}: exit status {ran.rc}: {ran.line}"


def _left(temporary: Path) -> list[str]:
    """Return what the last command, which ended by itself, has left or not swept."""
    until = time.monotonic() + 10
    while (left := [path.name for path in temporary.glob("graspq-*")]) and time.monotonic() < until:
        time.sleep(0.2)
    return left


@contextlib.contextmanager
def _steady(work: Work, case: Path) -> Iterator["subprocess.Popen[str]"]:
    """Yield a process that does a cycle whenever it is asked, always in the same process."""
    temporary = case / "t"  # of its own: what lies in the other is left by others
    temporary.mkdir()
    process = subprocess.Popen(
        [sys.executable, "-P", HERE / "steady.py"], cwd=case, env=work.environment({"TMPDIR": str(temporary)}),
        text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    try:
        yield process
    finally:
        assert process.stdin is not None
        process.stdin.close()
        process.wait()


def _answer(steady: "subprocess.Popen[str]") -> dict[str, int]:
    print("go", file=steady.stdin, flush=True)
    answer: dict[str, int] = json.loads(steady.stdout.readline())
    return answer


def _facts(started: float, cycles: int, kills: int, wrong: list[str], rows: list[dict[str, int]]) -> dict[str, object]:
    """Return what is published."""
    quarter = max(len(rows) // 4, 1)
    early = statistics.median(row["memory_kb"] for row in rows[quarter : 2 * quarter] or rows)
    late = statistics.median(row["memory_kb"] for row in rows[-quarter:])
    handles = [row["handles"] for row in rows[1:] or rows]
    return {
        "hours": round((time.monotonic() - started) / 3600, 2),
        "cycles": cycles,
        "kills": kills,
        "wrong": wrong,
        "memory_kb_early": early,
        "memory_kb_late": late,
        "handles_least": min(handles),
        "handles_most": max(handles),
        "flat": late <= GROWTH * early and max(handles) <= min(handles) + 4,
        "memory_kb_most": max(row["peak_kb"] for row in rows),
        "cores": len(os.sched_getaffinity(0)),
    }
