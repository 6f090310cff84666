"""`make faults`: breaks the real commands in every way that is listed, and says what became of them.

Goes on where it was stopped. Ends with results/faults.json and the table in RESULTS.md.
"""

import argparse
import os
import signal
import subprocess
import sys
import time
import types
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
# The root must not be on the path, where `datasets/` would hide another library; `tests` is found without.
sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() not in (ROOT, ROOT / "tests" / "faults")]
if not hasattr(sys.modules.get("tests"), "__file__"):
    tests = types.ModuleType("tests")
    tests.__path__ = [str(ROOT / "tests")]
    sys.modules["tests"] = tests

from graspq.common.files import write_json, write_text  # noqa: E402
from tests.faults.harness import (  # noqa: E402
    GOOD,
    HERE,
    MADE,
    Log,
    Results,
    Work,
    code_digest,
    rows_of,
    sentence,
    table,
    try_kind,
)
from tests.faults.kinds import KINDS  # noqa: E402
from tests.faults.planted import PLANTED, found_by  # noqa: E402
from tests.faults.soak import soak  # noqa: E402
from tests.faults.system_calls import shim  # noqa: E402

HARNESS = (HERE / "kinds.py",)  # imports all kinds
START, END = "<!-- made by tests/faults -->", "<!-- end of faults -->"


def main() -> int:
    """Try what was not tried yet; return 1 where a fault was lost, silently wrong, hung, a traceback, or not tried."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument("--kind", action="append", help="only kinds whose name holds this; may be repeated")
    parser.add_argument("--short", action="store_true", help="the few that `make test` tries; publishes nothing")
    parser.add_argument("--planted", action="store_true", help="plant defects, each of which must be found")
    parser.add_argument("--limit-minutes", type=float, default=float("inf"), help="stop after so long")
    parser.add_argument(
        "--workers", type=int, default=min(2, os.cpu_count() or 1), help="processes that share the work"
    )
    parser.add_argument("--part", type=int, help=argparse.SUPPRESS)  # of one of them
    parser.add_argument("--soak-hours", type=float, help="instead a loop with random kills: results/soak.json")
    given = parser.parse_args()
    if given.soak_hours is not None:
        return soak(given.soak_hours)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends in order, too
    until = time.monotonic() + 60 * given.limit_minutes
    folder = ROOT / "runs" / "faults"
    part = (0, 1) if given.part is None else (given.part, given.workers)
    log, results = Log(folder / "tried.jsonl"), []
    with Work(folder / code_digest(), shim=shim(folder)) as work:
        if given.planted:
            return try_planted(work, given.kind)
        if given.part is None and given.workers > 1:
            share(work, given.workers)
            log.read()
        for kind in KINDS:
            chosen = given.kind is None or any(name in kind.name for name in given.kind)
            code = code_digest(Path(sys.modules[type(kind).__module__].__file__ or ""))
            if chosen or given.part is None:
                # Of the others no more than what is known is told.
                results.append(try_kind(kind, work, log, code, given.short, until if chosen else 0.0, part))
    if given.part is not None:
        return 0
    rows = [row for one in results for row in rows_of(one)]
    day = datetime.now(UTC).date().isoformat()
    said, text = sentence(results, day, code_digest(*HARNESS)), table(rows)
    print(f"{said}\n\n{text}")
    red = any(tried.outcome not in GOOD for one in results for _, tried in one.tried)
    whole = all(one.whole for one in results)
    if given.short:
        return int(red)
    publish(results, rows, day, f"{said}\n\n{text}")
    return int(red or not whole)


def share(work: Work, workers: int) -> None:
    """Have processes of this program try what was not tried yet, each a part of it."""
    for name in MADE:
        work.made(name)
    work.rest()
    words = [sys.executable, "-P", str(Path(__file__).parent), *sys.argv[1:]]
    parts = [subprocess.Popen([*words, "--workers", str(workers), "--part", str(part)]) for part in range(workers)]
    try:
        codes = [one.wait() for one in parts]
        if any(codes):
            sys.exit("error: a process that tried faults has failed, so that some were not tried; run it again")
    finally:
        # A Ctrl-C of a terminal has reached them too: each takes away what it has started, made and mounted.
        for one in parts:
            try:
                one.wait(timeout=10.0)
            except subprocess.TimeoutExpired:
                one.terminate()  # nobody has told it
                one.wait()


def try_planted(work: Work, kinds: list[str] | None) -> int:
    """Plant each defect and say what found it; return 1 where one was not found."""
    missed = 0
    for planted in PLANTED:
        if kinds is None or any(name in planted.kind for name in kinds):
            kind = next(kind for kind in KINDS if kind.name == planted.kind)
            red = found_by(planted, kind, work)
            missed += red is None
            how = "NOT FOUND" if red is None else f"{red[0].command}, {red[0].name}: {red[1].outcome}: {red[1].said}"
            print(f"{planted.name} ({planted.kind}): {how}", flush=True)
    return int(missed > 0)


def publish(results: list[Results], rows: list[dict[str, object]], day: str, text: str) -> None:
    """Write results/faults.json, and the table between its marks in RESULTS.md."""
    kinds = [
        {"fault": one.kind, "planned": one.planned, "tried": len(one.tried), "why_not": one.why_not} for one in results
    ]
    facts = {"date": day, "code": code_digest(*HARNESS), "whole": all(one.whole for one in results)}
    write_json(ROOT / "results" / "faults.json", {**facts, "kinds": kinds, "rows": rows})
    page = ROOT / "RESULTS.md"
    before, _, rest = page.read_text().partition(START)
    _, _, after = rest.partition(END)
    write_text(page, f"{before}{START}\n\n{text}\n{END}{after}")


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit("interrupted; the same command goes on")
