"""Collection, training and evaluation in a loop for hours, with SIGKILLs at random moments.

    make soak HOURS=3

Every cycle ends in the same bytes as the first, which was left alone; nothing stays behind; and one process that does
the same work again and again keeps its memory and its file handles. Ends in results/soak.json, which stands after each
cycle.
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
from typing import Any

from graspq.common.files import write_json
from tests.faults.commands import TRAINING, Running, difference, essence
from tests.faults.harness import HERE, ROOT, Work, code_digest

LINES = (
    ("grasp-datagen --size 60 --seed 5 --objects objects --out data --workers 1", "data"),
    (f"grasp-train --algo mc --shards data --out run --steps 40 --seed 5 {TRAINING}", "run"),
    ("grasp-eval run --episodes 6 --films 1 --workers 1 --device cpu --out scores", "scores"),
)
RESULT = ROOT / "results" / "soak.json"
LIMIT_SECONDS = 600.0
GROWTH = 1.1  # of the memory of the one process, from the second quarter of its cycles to the last


def soak(hours: float, seed: int = 0) -> int:
    """Go on until so many hours are done; return 1 where anything was lost or grew.

    It may be done in several sittings: one that was stopped keeps the cycles that it has finished, and the same call
    does the hours that are left, with the same code.

    Args:
        hours: of all sittings; at least two cycles are done in each.
        seed: of the moments of the kills, with the number of the sitting.
    """
    code = code_digest(Path(__file__), HERE / "steady.py")
    sittings = _sittings(code)
    left = hours - sum(one["hours"] for one in sittings)
    if sittings and left <= 0:
        print(f"{hours:g} hours are done with this code: {RESULT}")
    else:
        for sitting in _sitting(left, random.Random(f"{seed} {len(sittings)}")):
            write_json(RESULT, _published(code, [*sittings, sitting]))
    facts = json.loads(RESULT.read_text())
    print(json.dumps(facts, indent=2))
    return int(bool(facts["wrong"]) or not facts["flat"])


def _sittings(code: str) -> list[dict[str, Any]]:
    """Return the sittings of before with this code."""
    found = json.loads(RESULT.read_text()) if RESULT.exists() else {}
    sittings: list[dict[str, Any]] = found["sittings"] if found.get("code") == code else []
    return sittings


def _published(code: str, sittings: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what is published: sums over the sittings, and each of them."""
    return {
        "hours": round(sum(one["hours"] for one in sittings), 2),
        "cycles": sum(one["cycles"] for one in sittings),
        "kills": sum(one["kills"] for one in sittings),
        "wrong": [wrong for one in sittings for wrong in one["wrong"]],
        "flat": all(one["flat"] for one in sittings),
        "code": code,
        "sittings": sittings,
    }


def _sitting(hours: float, draws: random.Random) -> Iterator[dict[str, Any]]:
    """Go on for so many hours; yield the facts after each cycle."""
    started = time.monotonic()
    folder = ROOT / "runs" / "soak"
    shutil.rmtree(folder, ignore_errors=True)
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
                left = _left(work.temporary)
                wrong += [f"cycle {cycles}: left {left}"] if left else []
                rows.append(_answer(steady))
                cycles += 1
                yield _facts(started, cycles, kills, wrong, rows)
                print(f"cycle {cycles}: {kills} kills, {len(wrong)} wrong, {rows[-1]}", flush=True)


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


def _facts(started: float, cycles: int, kills: int, wrong: list[str], rows: list[dict[str, int]]) -> dict[str, Any]:
    """Return what is published of a sitting."""
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
