"""Small runs of the commands whose system calls are counted, noted, failed or never reached; see `shim.c`."""

import hashlib
import json
import os
import shutil
import struct
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graspq.common.checksums import checked
from tests.faults.harness import HERE, PLAN, TRAINING, NotHereError, Ran, Work, digest_of

# As in shim.c.
OFF, NOTE, KILL, KILL_HALF, FAIL, FAIL_ON, FAIL_FILE = range(7)
WRITE, FSYNC, RENAME, CREATE, OPEN, READ, REMOVE, MKDIR, TRUNCATE, LINK, SAID = (1 << bit for bit in range(11))
CHANGES = WRITE | FSYNC | RENAME | CREATE | REMOVE | MKDIR | TRUNCATE | LINK
NEVER = 0
NO_COMPILER = "no C compiler (gcc or cc) here: system calls cannot be met"
# Not compared: times stand in them, or in their names.
TIMED = ("tensorboard", ".lock", "logs")
SPEEDS = ("samples_per_second", "training_seconds", "seconds")


@dataclass(frozen=True)
class Scenario:
    """A small run of a command.

    Attributes:
        command: its row in the table.
        words: the command line.
        inputs: of `Work`, which lie in its working folder.
        first: commands that have ended there before.
        files: name -> content of files that lie there besides.
    """

    command: str
    words: str
    inputs: tuple[str, ...] = ()
    first: tuple[str, ...] = ()
    files: tuple[tuple[str, str], ...] = ()

    @property
    def argv(self) -> list[str]:
        """The words of the command line."""
        return self.words.split()


SMALL_PLAN = PLAN.replace("steps = 4", "steps = 2").replace(", save_every = 2", "")
EVERY_STEP = TRAINING.replace("--save-every 2", "--save-every 1")
SCENARIOS = (
    Scenario("grasp-objects make", "grasp-objects make procedural new --train 1 --test 1 --validation 1"),
    Scenario("grasp-datagen", "grasp-datagen --size 2 --objects objects --workers 0 --out new", ("objects",)),
    Scenario(
        "grasp-datagen, growing",
        f"{HERE / 'small_dataset.py'} 12 new objects",
        ("objects",),
        (f"{HERE / 'small_dataset.py'} 3 new objects",),
    ),
    Scenario(
        "grasp-train",
        f"grasp-train --algo mc --shards data/regular-24 --out new --steps 5 {EVERY_STEP}",
        ("dataset",),
    ),
    Scenario(
        "grasp-online",
        "grasp-online --start runs/mc --rounds 2 --grasps 1 --steps-per-round 2 --save-every 2 --workers 0 --out new",
        ("dataset", "run"),
    ),
    Scenario(
        "grasp-eval",
        "grasp-eval runs/mc --policy random --episodes 2 --films 1 --workers 0 --device cpu --out new",
        ("dataset", "run"),
    ),
    Scenario(
        "grasp-sweep",
        "grasp-sweep --algo mc --shards data/regular-24 --learning-rate 0.001 --width 4 --seeds 1 --steps 2 "
        "--episodes 1 --vary batch_size=8 --threads 1 --workers 0 --device cpu --out new",
        ("dataset",),
    ),
    Scenario(
        "grasp-study",
        "grasp-study run plan.toml --out new --workers 0 --device cpu --results new-results --page page.md",
        ("dataset",),
        ("grasp-study freeze plan.toml --out new",),
        (("plan.toml", SMALL_PLAN),),
    ),
)
OF_COMMAND = {scenario.command: scenario for scenario in SCENARIOS}


MAKES, TRAINS = "grasp-objects make", "grasp-train"  # of which `make test` tries one for each kind, or none


def scenarios(work: Work, short: bool, command: str | None = MAKES) -> Sequence[Scenario]:
    """Return the scenarios that are tried: all, one or none for `make test`."""
    if work.shim is None:
        raise NotHereError(NO_COMPILER)
    return [scenario for scenario in SCENARIOS if not short or scenario.command == command]


def compiled(source: Path, folder: Path) -> Path | None:
    """Return a C file as a library to preload; None without a compiler."""
    compiler = next(filter(None, map(shutil.which, ("gcc", "cc"))), None)
    if compiler is None:
        return None
    folder.mkdir(parents=True, exist_ok=True)
    library, made = folder / f"{source.stem}.so", folder / f"{source.stem}-{os.getpid()}.so"
    subprocess.run([compiler, "-O1", "-shared", "-fPIC", "-o", made, source, "-ldl", "-lpthread"], check=True)
    made.replace(library)  # in one step: another process may be at the same
    return library


def shim(folder: Path) -> Path | None:
    """Return `shim.c` compiled; None without a compiler."""
    return compiled(HERE / "shim.c", folder)


def armed(
    case: Path, mode: int, at: int = NEVER, *, error: int = 0, calls: int = CHANGES, log: Path | None = None
) -> Any:
    """Return what `Work.forked` is to do to the calls on files below a working folder."""
    return {
        "under": str(case), "mode": mode, "at": at, "error": error, "log": "" if log is None else str(log),
        "calls": calls,
    }  # fmt: skip


@dataclass(frozen=True)
class Call:
    """A system call as it was noted: paths relative to the working folder; `place` is an offset, a size or flags."""

    what: int
    failed: bool
    place: int
    path: str
    other: str
    data: bytes


@dataclass(frozen=True)
class Unbroken:
    """What a scenario does where nothing goes wrong.

    Attributes:
        calls: all that it did with files of its working folder, and what it said.
        files: what it left; see `compared`.
        stdout: what it said in the end.
    """

    calls: Sequence[Call]
    files: dict[str, str]
    stdout: str

    @property
    def changes(self) -> list[Call]:
        """The calls that change files."""
        return [call for call in self.calls if call.what & CHANGES]

    def count(self, calls: int) -> int:
        """Return how many calls of some sorts there were."""
        return sum(bool(call.what & calls) for call in self.calls)


class Stage:
    """Scenarios of one `Work`: where each begins, and what comes of it unbroken."""

    def __init__(self, work: Work) -> None:
        self._work = work
        self._unbroken: dict[str, Unbroken] = {}

    def start(self, scenario: Scenario) -> Path:
        """Return the working folder that a scenario begins in; to read only."""
        with self._work.alone():
            return self._start(scenario)

    def _start(self, scenario: Scenario) -> Path:
        which = hashlib.sha256(repr(scenario).encode()).hexdigest()[:16]
        folder = self._work.folder / "starts" / which
        note = folder.with_name(f"{folder.name}-made")
        if not note.exists():
            shutil.rmtree(folder, ignore_errors=True)
            with self._work.copy(*scenario.inputs) as case:
                for name, content in scenario.files:
                    (case / name).write_text(content)
                for command in scenario.first:
                    ended(self._work.forked(command.split(), case), command)
                shutil.copytree(case, folder, symlinks=True)
            note.touch()
        return folder

    def begun(self, scenario: Scenario) -> "Begun":
        """Return a context of a fresh working folder."""
        self.unbroken(scenario)  # now, in a folder of the same path: that stands in some files
        return Begun(self._work, self.start(scenario))

    def unbroken(self, scenario: Scenario) -> Unbroken:
        """Return what comes of a scenario where nothing goes wrong."""
        if scenario.command not in self._unbroken:
            with Begun(self._work, self.start(scenario)) as case:
                log = case.with_name(f"{case.name}-calls")
                try:
                    ran = self._work.forked(
                        scenario.argv, case, armed=armed(case, NOTE, log=log, calls=CHANGES | OPEN | READ)
                    )
                    ended(ran, scenario.words)
                    calls = list(calls_in(log.read_bytes(), case))
                finally:
                    log.unlink(missing_ok=True)
                self._unbroken[scenario.command] = Unbroken(calls, compared(case), ran.stdout)
        return self._unbroken[scenario.command]


class Begun:
    """A copy of a folder, removed in the end."""

    def __init__(self, work: Work, start: Path) -> None:
        self._copy, self._start = work.copy(), start

    def __enter__(self) -> Path:
        case = self._copy.__enter__()
        shutil.copytree(self._start, case, symlinks=True, dirs_exist_ok=True)
        return case

    def __exit__(self, *ending: Any) -> None:
        self._copy.__exit__(*ending)


def ended(ran: Ran, what: str) -> None:
    """Raise RuntimeError unless a command ended well."""
    if ran.rc != 0:
        raise RuntimeError(f"{what}: {ran.rc}\n{ran.stderr}")


def calls_in(log: bytes, case: Path) -> Iterator[Call]:
    """Yield the calls of a log that `shim.c` wrote."""
    place, head = 0, struct.Struct("=6q")
    above = f"{case}/"
    while place < len(log):
        what, result, at, length, length2, size = head.unpack_from(log, place)
        place += head.size
        parts = []
        for part in (length, length2, size):
            parts.append(log[place : place + part])
            place += part
        path, other = (f"{part.decode()}/".removeprefix(above).rstrip("/") for part in parts[:2])
        yield Call(what, result < 0, at, path, other, parts[2])


def compared(folder: Path) -> dict[str, str]:
    """Return path -> digest of all that a command has left, without figures of speed."""
    found = digest_of(folder, TIMED)
    for name in found:
        path = folder / name
        if path.suffix in (".jsonl", ".csv") and path.is_file():
            found[name] = _without_speeds(path)
    return found


def _without_speeds(path: Path) -> str:
    lines = path.read_text(errors="replace").splitlines(keepends=True)
    if path.suffix == ".jsonl":
        return "".join(_without(line) for line in lines)
    heads = lines[0].rstrip("\n").split(",") if lines else []
    timed = {number for number, head in enumerate(heads) if head in SPEEDS}
    kept = [[cell for number, cell in enumerate(line.rstrip("\n").split(",")) if number not in timed] for line in lines]
    return "\n".join(",".join(cells) for cells in kept)


def _without(line: str) -> str:
    """Return a line without figures of speed, after its checksum, which is of them too, was found right."""
    try:
        row, signed = checked(line.encode())
    except ValueError:
        return line
    kept = {name: value for name, value in row.items() if name not in SPEEDS} if isinstance(row, dict) else row
    return f"{json.dumps(kept)}{' and its checksum' if signed else ''}{line[-1:]}"


def difference(found: dict[str, str], expected: dict[str, str]) -> str | None:
    """Return the first file that is missing, too many or another; None where there is none."""
    for name in sorted({*found, *expected}):
        if found.get(name) != expected.get(name):
            what = "left over" if name not in expected else "missing" if name not in found else "another"
            return f"{name}: {what}"
    return None
