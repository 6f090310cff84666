"""The commands that faults meet, each on small work of its own, and what must be the same however they got there."""

import contextlib
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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.faults.harness import MADE, SECONDS, TRAINING, Ran, Tried, Work

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
    """

    words: tuple[str, ...]
    needs: tuple[str, ...]
    result: str = ""
    made: str = ""

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

    def reference(self, work: Work) -> dict[str, Any]:
        """Return the essence of what an unbroken run makes."""
        work.made(self.made)
        return essence(work.inputs / self.result)

    def fits(self, case: Path, work: Work, *, interrupted: bool = False) -> Tried:
        """Compare what it has made with an unbroken run's.

        A training that was interrupted wrote what it had measured since its last row: rows have other bounds then, and
        those of validations alone are compared. It wrote a checkpoint, too, that an unbroken run has not, and that one
        pushed out an older one: those of the steps that both have are compared, the last one among them.
        """
        if not self.made:
            return Tried("survived")
        found, expected = essence(case / self.result), self.reference(work)
        for one in (found, expected) if interrupted else ():
            for name in one:
                if name.endswith("metrics.jsonl") and isinstance(one[name], list):
                    one[name] = [row for row in one[name] if "validation" in row]
        if interrupted:
            found, expected = with_checkpoints_of(found, expected), with_checkpoints_of(expected, found)
        differs = difference(found, expected)
        return Tried("survived") if differs is None else Tried("silently wrong", differs)

    def goes_on(self, case: Path, work: Work, env: Mapping[str, str] | None = None) -> Tried:
        """Run the same command again, and compare: nothing may be lost, and it must come to its end."""
        again = work.forked(self.words, case, env=env)
        broken = again.broken()
        if broken is not None:
            return broken
        return self.fits(case, work, interrupted=True) if again.rc == 0 else Tried("lost", again.line)


def _of(made: str, *needs: str) -> Line:
    return Line(tuple(shlex.split(MADE[made][1][-1])), needs, MADE[made][0], made)


OBJECTS, DATAGEN, TRAIN = _of("objects"), _of("dataset", "objects"), _of("run", "dataset")
EVAL, SWEEP, STUDY = _of("evaluation", "dataset", "run"), _of("sweep", "dataset"), _of("study", "dataset")
ONLINE = _of("online", "dataset", "run")
REPORT = Line(
    ("grasp-report", "runs", "scores", "--out", "report.html"), ("dataset", "run", "evaluation"), "report.html"
)
VERIFY = Line(("grasp-data", "verify", "data/regular-24", "--workers", "0"), ("dataset",))
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
        if path.suffix in (".csv", ".html", ".md"):
            return "there"
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

    def until(self, there: Callable[[], Any], seconds: float = 60.0) -> bool:
        """Wait until something is there, or the command has ended; return whether it still runs."""
        until = time.monotonic() + seconds
        while self.process.poll() is None and not there() and time.monotonic() < until:
            time.sleep(0.01)
        return self.process.poll() is None

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


def one_line(ran: Ran) -> bool:
    """Return whether a command refused in one line: a mistake of the user, or a failure of the machine."""
    return ran.rc in (2, 74) and re.search(r"(?m)^error: .+$", ran.stderr) is not None
