"""The commands that faults meet, each on small work of its own, and what must be the same however they got there."""

import contextlib
import csv
import hashlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tests.faults.harness import MADE, SECONDS, TRAINING, CommittedWork, Ran, Tried, Work, digest_of

# What no two runs share: speed, the revision of the code, and digests of rows that hold them.
_VARYING = {
    "samples_per_second", "training_seconds", "code_revision", "trained_by", "scored_by", "digest", "sha256",
    "checksum",
}  # fmt: skip
# What the words of a command say, not what comes of them.
_SAID = {"shards", "out", "run", "command", "objects", "start_run", "workers", "threads", "engine", "folder"}
_LEFT_OUT = (".lock", "tensorboard", "logs")
_CHECKPOINT = re.compile(r"(.*\bcheckpoints)/step-(\d+)/")


@dataclass(frozen=True)
class Line:
    """A command line.

    Attributes:
        words: of the command.
        needs: inputs that must be there.
        result: what it makes, a path; "" for nothing.
        made: the input that an unbroken run of it made.
        beside: paths of what it makes besides.
        says: what it says in the end is compared, not what it makes.
    """

    words: tuple[str, ...]
    needs: tuple[str, ...]
    result: str = ""
    made: str = ""
    beside: tuple[str, ...] = ()
    says: bool = False

    @property
    def name(self) -> str:
        """The command, as the table names it."""
        script = Path(self.words[0])
        return "grasp-datagen" if script.suffix == ".py" else script.name

    @contextlib.contextmanager
    def case(self, work: Work) -> Iterator[Path]:
        """Yield a folder in which it can begin; it is the working folder."""
        with work.copy(*self.needs) as case:
            if self.name == "grasp-study":
                work.made("study")
                for name in ("plan.toml", "recipe.json"):
                    (case / name).write_bytes((work.inputs / name).read_bytes())
            yield case

    def all_made(self, folder: Path) -> dict[str, Any]:
        """Return the essence of all that it makes in a folder."""
        found = essence(folder / self.result)
        for name in self.beside:
            found |= {f"{name}/{inside}": one for inside, one in essence(folder / name).items()}
        return found

    def fits(self, case: Path, work: Work, ran: Ran | None = None, *, interrupted: bool = False) -> Tried:
        """Compare what it has made with an unbroken run's, and that nothing temporary is left.

        A training that was interrupted wrote what it had measured since its last row: rows have other bounds then, see
        `rows_differ`. It wrote a checkpoint, too, that an unbroken run has not, and that one pushed out an older one:
        those of the steps that both have are compared, the last one among them.

        Args:
            case: the working folder.
            work: that it is a case of.
            ran: how it ended, where what it said could be heard.
            interrupted: whether it was, and has gone on.
        """
        left = work.left_over(case)
        if left is not None:
            return Tried("lost", f"{left}: left over")
        if self.says:
            if ran is None or _told(ran.stdout) == _told(self._said(work)):
                return Tried("survived")
            return Tried("silently wrong", f"says another thing: {ran.stdout[-200:]}")
        if not self.made:
            return Tried("survived")
        work.made(self.made)
        found, expected = self.all_made(case), self.all_made(work.inputs)
        if interrupted:
            for name in [name for name in found.keys() & expected.keys() if name.endswith("metrics.jsonl")]:
                differs = rows_differ(found.pop(name), expected.pop(name))
                if differs is not None:
                    return Tried("silently wrong", f"{name}: {differs}")
            found, expected = with_checkpoints_of(found, expected), with_checkpoints_of(expected, found)
        differs = difference(found, expected)
        return Tried("survived") if differs is None else Tried("silently wrong", differs)

    def _said(self, work: Work) -> str:
        """Return what the command says of the inputs, whatever its words call them here."""
        line = next(line for line in LINES if line.name == self.name)
        if self.name not in _SAYINGS:
            with line.case(work) as case:
                _SAYINGS[self.name] = work.forked(line.words, case).stdout
        return _SAYINGS[self.name]

    def committed(self, case: Path, work: Work) -> CommittedWork:
        """Take note of what is whole in a folder that it was broken off in."""
        whole = digest_of(work.made(self.made)) if self.made and (work.inputs / self.result).is_dir() else {}
        return CommittedWork(case / self.result, whole)

    def goes_on(self, case: Path, work: Work, env: Mapping[str, str] | None = None) -> Tried:
        """Run the same command again, and compare: nothing may be lost, and it must come to its end."""
        committed = self.committed(case, work)
        again = work.forked(self.words, case, env=env)
        broken = again.broken()
        if broken is not None:
            return broken
        if again.rc != 0:
            return Tried("lost", again.line)
        return committed.lost() or self.fits(case, work, again, interrupted=True)


_SAYINGS: dict[str, str] = {}


def _told(said: str) -> str:
    """Return what a command said of a folder, without the folder's name."""
    return said.strip().rpartition(": ")[2]


def line_of(made: str, *needs: str) -> Line:
    """Return the command that makes an input of the harness, and what it needs."""
    return Line(tuple(shlex.split(MADE[made][1][-1])), needs, MADE[made][0], made)


OBJECTS, DATAGEN, TRAIN = line_of("objects"), line_of("dataset", "objects"), line_of("run", "dataset")
EVAL, SWEEP = line_of("evaluation", "dataset", "run"), line_of("sweep", "dataset")
STUDY = replace(line_of("study", "dataset"), beside=("results", "page.md", "recipe.json"))
ONLINE = line_of("online", "dataset", "run")
REPORT = line_of("report", "dataset", "run", "evaluation")
VERIFY = Line(("grasp-data", "verify", "data/regular-24", "--workers", "0"), ("dataset",), says=True)
LINES = (OBJECTS, DATAGEN, TRAIN, EVAL, SWEEP, STUDY, ONLINE, REPORT, VERIFY)
MAKING = (OBJECTS, DATAGEN, TRAIN, EVAL, SWEEP, STUDY, ONLINE)


def training(out: str = "runs/mc", seed: int = 0, steps: int = 8) -> Line:
    """Return a training."""
    words = f"grasp-train --algo mc --shards data/regular-24 --out {out} --steps {steps} --seed {seed} {TRAINING}"
    return Line(tuple(words.split()), ("dataset",), out)


def essence(place: Path) -> dict[str, Any]:
    """Return what must be equal of a file, or of all files below a folder: path → digest, or the values that matter."""
    paths = sorted(place.rglob("*")) if place.is_dir() else [place]
    found = {}
    for path in paths:
        inside = path.relative_to(place).parts
        if path.is_file() and not any(part in _LEFT_OUT for part in inside):
            found["/".join(inside)] = _content(path)
    return found


def rows_differ(found: Any, expected: Any) -> str | None:
    """Return in words what is wrong with the metrics of a training that was interrupted; None where nothing is.

    Validations and rounds are all the same. Steps of the rows of losses grow up to the last; those of equal bounds are
    the same.
    """
    if not isinstance(found, list) or not isinstance(expected, list):
        return None if found == expected else "is another than that of an unbroken run"
    if [row for row in found if "loss" not in row] != [row for row in expected if "loss" not in row]:
        return "its validations or rounds are others than those of an unbroken run"
    trained, whole = ([row for row in rows if "loss" in row] for rows in (found, expected))
    steps = [row["step"] for row in trained]
    if steps != sorted(set(steps)) or steps[-1:] != [row["step"] for row in whole][-1:]:
        return f"its steps are {steps}"
    ours, theirs = (
        {(before.get("step"), row["step"]): row for before, row in zip([{}, *rows], rows, strict=False)}
        for rows in (trained, whole)
    )
    differing = next((bounds for bounds in ours.keys() & theirs.keys() if ours[bounds] != theirs[bounds]), None)
    return None if differing is None else f"its row of the steps {differing} is another than that of an unbroken run"


def with_checkpoints_of(one: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """Return an essence without the checkpoints that the other lacks: each run's last stays, and their number."""
    ours, theirs = _checkpoints(one), _checkpoints(other)
    kept = {(run, step) for run, steps in ours.items() for step in steps & theirs.get(run, set()) | {max(steps)}}
    left = {name: value for name, value in one.items() if _place(name) in kept | {None}}
    return left | {run: len(steps) for run, steps in ours.items()}


def _checkpoints(found: Iterable[str]) -> dict[str, set[int]]:
    """Return the steps of each run's checkpoints."""
    steps: dict[str, set[int]] = {}
    for run, step in filter(None, map(_place, found)):
        steps.setdefault(run, set()).add(step)
    return steps


def _place(name: str) -> tuple[str, int] | None:
    """Return the folder of checkpoints and the step of one of their files."""
    match = _CHECKPOINT.match(name)
    return (match[1], int(match[2])) if match is not None else None


def _content(path: Path) -> Any:
    text = path.read_bytes()
    try:
        if path.name in ("config.json", "eval.json", "plan.json"):
            return _kept(json.loads(text))
        if path.suffix == ".jsonl":
            return [_kept(json.loads(line)) for line in text.splitlines()]
        if path.suffix == ".csv":
            rows = csv.DictReader(text.decode().splitlines())
            return [{name: cell for name, cell in row.items() if name not in _VARYING | _SAID} for row in rows]
        if path.suffix == ".md":  # its words say where it was made, and of which revision of the code
            return [line for line in text.splitlines() if line.startswith(b"|")]
    except ValueError as error:
        return f"{path.name} is no JSON: {error}"
    return hashlib.sha256(text).hexdigest()


def _kept(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _kept(one) for name, one in value.items() if name not in _VARYING | _SAID}
    return [_kept(one) for one in value] if isinstance(value, list) else value


def difference(found: Mapping[str, Any], expected: Mapping[str, Any]) -> str | None:
    """Return in words where two essences differ, None where they do not."""
    for name in sorted(found.keys() | expected.keys()):
        if name not in found or name not in expected:
            return f"{name} is {'missing' if name not in found else 'there and should not be'}"
        if found[name] != expected[name]:
            return f"{name} is another than that of an unbroken run"
    return None


class Running:
    """A command as a process that is still running; what it has started is in its process group."""

    def __init__(
        self, work: Work, words: Sequence[str | Path], cwd: Path, env: Mapping[str, str] | None = None, **options: Any
    ) -> None:
        program, *arguments = map(str, words)
        script = [sys.executable, "-P", program]
        start = script if program.endswith(".py") else [str(Path(sys.executable).with_name(program))]
        streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        streams |= {"preexec_fn": _with_usual_signals}
        self._start = time.monotonic()
        self.process = subprocess.Popen(
            [*start, *arguments], cwd=cwd, env=work.environment(env), start_new_session=True, **streams | options
        )
        work.started[:] = [*(one for one in work.started if one.poll() is None), self.process]

    def until(self, there: Callable[[], Any], seconds: float = SECONDS) -> bool:
        """Wait until something is there, or the command has ended; return whether it still runs."""
        until = time.monotonic() + seconds
        while self.process.poll() is None and not there() and time.monotonic() < until:
            time.sleep(0.01)
        return self.process.poll() is None

    def has_open(self, folder: Path) -> bool:
        """Return whether it has a file below a folder open."""
        with contextlib.suppress(OSError):
            return any(
                os.fspath(link.readlink()).startswith(f"{folder}/")
                for link in Path(f"/proc/{self.process.pid}/fd").iterdir()
            )
        return False

    def send(self, number: signal.Signals) -> None:
        """Send a signal to the process group, as a terminal does."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, number)

    def descendants(self) -> list[int]:
        """Return the processes that it has started, and those that these have, oldest first."""
        parents: dict[int, int] = {}
        for entry in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                stat = (entry / "stat").read_text().rpartition(")")[2].split()
                if stat[0] != "Z":
                    parents[int(entry.name)] = int(stat[1])
        found = [self.process.pid]
        for one in found:
            found += [child for child, parent in parents.items() if parent == one]
        return found[1:]

    def workers(self) -> list[int]:
        """Return its workers: children of the server that forks them."""
        found = []
        for one in self.descendants():
            with contextlib.suppress(OSError):
                command = Path(f"/proc/{one}/cmdline").read_bytes()
                parent = int(Path(f"/proc/{one}/stat").read_text().rpartition(")")[2].split()[1])
                if b"forkserver" in command and parent != self.process.pid:
                    found.append(one)
        return found

    def ended(self, seconds: float = SECONDS) -> Ran:
        """Wait for its end, and kill it where it does not end in time."""
        try:
            out, err = self.process.communicate(timeout=seconds)
            hung = False
        except subprocess.TimeoutExpired:
            hung = True
        self.send(signal.SIGKILL)
        if hung:
            out, err = self.process.communicate()
        out, err = ((text or b"").decode(errors="replace") for text in (out, err))
        return Ran(self.process.returncode, out, err, time.monotonic() - self._start, hung)


def _with_usual_signals() -> None:
    """Let no signal be ignored because it was so where the harness was started, as in the background or by nohup."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
