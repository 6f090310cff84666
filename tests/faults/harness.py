"""What all faults share: small real work to damage, commands that are run on it, and one table of what became of them.

A kind of fault is a class with a name, a list of its faults and a way to try one; `KINDS` in `__main__` has them all.
"""

import contextlib
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol, get_args

import filelock

from graspq.common.text import markdown

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
Outcome = Literal["survived", "detected", "lost", "silently wrong", "hung", "traceback"]
OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)
GOOD: tuple[Outcome, ...] = ("survived", "detected")
SECONDS = 300.0  # a command that takes longer hangs; machines that others share are slow
TRACEBACK = "Traceback (most recent call last)"


@dataclass(frozen=True)
class Fault:
    """One fault, replayable by its name alone.

    Attributes:
        kind: name of its kind, a row group of the table.
        command: the command that meets it, a row of the table.
        name: unique within kind and command.
    """

    kind: str
    command: str
    name: str


@dataclass(frozen=True)
class Tried:
    """What became of a fault, the line that the command said or what was found, and how many cases it was of."""

    outcome: Outcome
    said: str = ""
    cases: int = 1


@dataclass(frozen=True)
class Ran:
    """How a command ended; `rc` is minus the signal's number where one ended it."""

    rc: int
    stdout: str
    stderr: str
    seconds: float
    hung: bool

    @property
    def traceback(self) -> bool:
        """Whether it showed a traceback."""
        return TRACEBACK in self.stderr or TRACEBACK in self.stdout

    @property
    def line(self) -> str:
        """The last line that it said on standard error."""
        return next((line.strip() for line in reversed(self.stderr.splitlines()) if line.strip()), "")

    def broken(self) -> Tried | None:
        """Return what is wrong whatever was expected: it hung, showed a traceback, or a signal ended it."""
        if self.hung:
            return Tried("hung", self.line)
        if self.traceback:
            return Tried("traceback", self.line)
        if self.rc < 0:
            return Tried("traceback", f"ended by {signal.Signals(-self.rc).name}: {self.line}")
        return None

    @property
    def one_line(self) -> bool:
        """Whether it refused in one line, its last: a mistake of the user, or a failure of the machine.

        `grasp-data verify` says a line for each fault, and then how many there are.
        """
        said = self.stderr.splitlines()
        if self.rc == 2 and any(line.startswith("fault: ") for line in said):
            return "fault" in self.line
        lines = [line for line in said if line.startswith("error: ") or line.endswith("--help)")]
        return self.rc in (2, 74) and len(lines) == 1 and lines[0].strip() == self.line

    def refused(self, *named: str) -> Tried:
        """Judge a command that had to refuse: one line, which names one of `named` where any are given."""
        broken = self.broken()
        if broken is not None:
            return broken
        if self.rc == 0:
            return Tried("silently wrong", f"exit status 0: {self.line}")
        if not self.one_line:
            return Tried("silently wrong", f"exit status {self.rc}, not one line: {self.stderr[-300:]}")
        if named and not any(name in self.stderr for name in named):
            return Tried("silently wrong", f"names none of {', '.join(named)}: {self.line}")
        return Tried("detected", self.line)


class NotHereError(Exception):
    """A kind of fault cannot be tried on this machine; says why."""


class Kind(Protocol):
    """A kind of fault."""

    name: str

    def faults(self, work: "Work", short: bool) -> Iterable[Fault]:
        """Return all faults, or a few of each command for `make test`.

        Raises:
            NotHereError: none can be tried on this machine.
        """

    def tried(self, fault: Fault, work: "Work") -> Tried:
        """Try one; whatever it leaves in a copy of the work is thrown away."""


# Name -> path of an input below the folder of the work, and the commands that make it, run there.
PLAN = """rows = ["mc"]
sizes = ["24"]
seeds = 1
preset = "paper"
steps = 4
episodes = 2
data = "data"
recipe = "recipe.json"
policies = ["random"]
threads = 1
options = {width = 4, batch_size = 8, save_every = 2}
"""
TRAINING = (
    "--preset paper --width 4 --batch-size 8 --validation-fraction 0.3 --save-every 2 --device cpu --precision float32 "
    "--threads 1"
)
MADE: dict[str, tuple[str, tuple[str, ...]]] = {
    "objects": ("objects", ("grasp-objects make procedural objects --train 6 --test 6 --validation 6",)),
    "dataset": ("data/regular-24", (f"{HERE / 'small_dataset.py'} 24 data/regular-24 objects",)),
    "other": (
        "other-24",
        (
            "grasp-objects make procedural other-objects --train 6 --test 6 --validation 6 --seed 5",
            f"{HERE / 'small_dataset.py'} 24 other-24 other-objects",
        ),
    ),
    "run": ("runs/mc", (f"grasp-train --algo mc --shards data/regular-24 --out runs/mc --steps 8 {TRAINING}",)),
    "evaluation": (
        "scores",
        ("grasp-eval runs/mc --episodes 4 --films 1 --workers 0 --device cpu --out scores",),
    ),
    "sweep": (
        "sweep",
        (
            "grasp-sweep --algo mc --shards data/regular-24 --learning-rate 0.001 --width 4 --seeds 1 --steps 4 "
            "--episodes 2 --vary batch_size=8 --threads 1 --workers 0 --device cpu --out sweep",
        ),
    ),
    "study": (
        "study",
        (
            "grasp-study freeze plan.toml --out study",
            "grasp-study run plan.toml --out study --workers 0 --device cpu --results results --page page.md",
        ),
    ),
    "online": (
        "runs/online",
        (
            "grasp-online --start runs/mc --rounds 2 --grasps 2 --steps-per-round 3 --save-every 2 --workers 0 "
            "--out runs/online",
        ),
    ),
    "report": ("report.html", ("grasp-report runs/mc scores --out report.html",)),
}
NEEDS = {
    "dataset": ("objects",), "run": ("dataset",), "evaluation": ("run",), "online": ("run",), "report": ("evaluation",),
    "sweep": ("dataset",), "study": ("dataset",), "collection": ("objects",),
    "longer evaluation": ("run",), "collection for Ray": ("objects",),
}  # fmt: skip
BESIDE = ("plan.toml", "recipe.json", "results", "page.md")  # of the study


class Work:
    """A folder of small real inputs, each made once by the real commands, and processes that work on copies of them.

    Attributes:
        folder: everything is below it.
        inputs: the inputs; read only.
        temporary: folder for temporary files of commands.
        source: folder that `graspq` is imported from in the place of this tree; see `planted`.
        shim: `shim.c`, compiled; None where there is no compiler.
    """

    def __init__(self, folder: Path, source: Path | None = None, shim: Path | None = None) -> None:
        self.folder, self.inputs, self.source = folder.absolute(), folder.absolute() / "inputs", source
        self.shim = shim
        self._templates: dict[bool, subprocess.Popen[str]] = {}  # lean or not
        self.started: list[subprocess.Popen[bytes]] = []  # leaders of process groups, which end with this work
        self._own = self.folder / "cases" / str(os.getpid())  # two may work here at once
        self.temporary = self._own / "temporary"
        self.inputs.mkdir(parents=True, exist_ok=True)
        _remove_forsaken(self.folder / "cases")
        self._lock = filelock.FileLock(self.folder / "lock")

    def __enter__(self) -> "Work":
        return self

    def __exit__(self, *_: object) -> None:
        self.rest()
        for process in self.started:
            if process.poll() is None:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
        shutil.rmtree(self._own, ignore_errors=True)

    def rest(self) -> None:
        """End the processes that commands are forked from; the next starts another."""
        for template in self._templates.values():
            assert template.stdin is not None
            template.stdin.close()
            template.terminate()  # it may wait for a command, which ends with it
            template.wait()
        self._templates.clear()

    def made(self, name: str) -> Path:
        """Return an input, made with all that it needs if it is not there yet; to read only."""
        with self.alone():
            return self._made(name)

    def alone(self) -> filelock.BaseFileLock:
        """Return a lock that one process of those that share this folder holds at a time; it may enter it again."""
        return self._lock

    def _made(self, name: str) -> Path:
        note = self.inputs / f".{name}-made"
        if not note.exists():
            for other in NEEDS.get(name, ()):
                self.made(other)
            if name == "study":
                (self.inputs / "plan.toml").write_text(PLAN)
            for command in MADE[name][1]:
                ran = self.forked(command.split(), self.inputs)
                if ran.rc != 0:
                    raise RuntimeError(f"{command}: {ran.rc}\n{ran.stderr}")
            note.touch()
        return self.inputs / MADE[name][0]

    objects = property(lambda self: self.made("objects"))
    dataset = property(lambda self: self.made("dataset"))
    run_folder = property(lambda self: self.made("run"))
    evaluation = property(lambda self: self.made("evaluation"))
    sweep = property(lambda self: self.made("sweep"))
    study = property(lambda self: self.made("study"))
    online = property(lambda self: self.made("online"))

    @contextlib.contextmanager
    def copy(self, *names: str) -> Iterator[Path]:
        """Yield a fresh folder to damage, with copies of inputs at the places that they have in `inputs`.

        It is the working folder for commands, and is removed afterwards.
        """
        # One after the other, all have the same path: it stands in some files.
        case = next(self._own / str(number) for number in range(100) if not (self._own / str(number)).exists())
        case.mkdir(parents=True)
        try:
            for name in names:
                made = self.made(name)
                shutil.copytree(made, case / MADE[name][0], symlinks=True)
                for beside in BESIDE if name == "study" else ():
                    there = self.inputs / beside
                    if there.is_dir():
                        shutil.copytree(there, case / beside)
                    elif there.exists():
                        shutil.copy2(there, case / beside)
            yield case
        finally:
            shutil.rmtree(case, ignore_errors=True)
            shutil.rmtree(self.temporary, ignore_errors=True)

    def left_over(self, case: Path) -> str | None:
        """Return a temporary file or folder that a command has left in a case or in the folder for such."""
        found = [*case.rglob(".tmp-*"), *self.temporary.glob("graspq-*")]
        return next((path.name for path in found), None)

    def run(
        self,
        argv: Sequence[str | Path],
        cwd: Path,
        *,
        env: Mapping[str, str] | None = None,
        before: Sequence[str] = (),
        seconds: float = SECONDS,
        preexec: Callable[[], None] | None = None,
    ) -> Ran:
        """Run a command (`grasp-train ...`, or a script) as a user does, in a process that is started anew.

        Args:
            argv: its words.
            cwd: working folder.
            env: variables to change.
            before: words that stand before the command, such as `strace ...`.
            seconds: it, and all that it has started, is killed after so long, and has hung.
            preexec: called in the process before the command begins.
        """
        program, *arguments = map(str, argv)
        script = [sys.executable, "-P", program]
        words = script if program.endswith(".py") else [str(Path(sys.executable).with_name(program))]
        start = time.monotonic()
        with subprocess.Popen(
            [*before, *words, *arguments],
            cwd=cwd,
            env=self.environment(env),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
            preexec_fn=preexec,
        ) as process:
            try:
                out, err = process.communicate(timeout=seconds)
                hung = False
            except subprocess.TimeoutExpired:
                hung = True
            finally:  # also where the harness is interrupted
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
            if hung:
                out, err = process.communicate()
        return Ran(
            process.returncode, out.decode(errors="replace"), err.decode(errors="replace"),
            time.monotonic() - start, hung,
        )  # fmt: skip

    def forked(
        self,
        argv: Sequence[str | Path],
        cwd: Path,
        *,
        env: Mapping[str, str] | None = None,
        seconds: float = SECONDS,
        limits: Mapping[str, int] | None = None,
        armed: Mapping[str, Any] | None = None,
        stdin: str = os.devnull,
        lean: bool = False,
    ) -> Ran:
        """Run a command in a child, forked for it alone, of a process that has imported all commands: see `template`.

        Args:
            argv: its words.
            cwd: working folder.
            env: variables to change.
            seconds: see `run`.
            limits: `RLIMIT_...` -> soft and hard limit.
            armed: what `shim.c` does to its system calls.
            stdin: path of its standard input.
            lean: of a process that has not imported what the commands import late.
        """
        template = self._started(lean)
        assert template.stdin is not None and template.stdout is not None
        said = self._own / "said"
        said.mkdir(parents=True, exist_ok=True)
        request = {
            "argv": [str(word) for word in argv], "cwd": str(cwd), "env": self.environment(env), "stdin": stdin,
            "stdout": str(said / "out"), "stderr": str(said / "err"), "seconds": seconds, "limits": dict(limits or {}),
            "armed": None if armed is None else dict(armed),
        }  # fmt: skip
        print(json.dumps(request), file=template.stdin, flush=True)
        answer = json.loads(template.stdout.readline())
        out, err = ((said / name).read_text(errors="replace") for name in ("out", "err"))
        return Ran(stdout=out, stderr=err, **answer)

    def address_space(self, lean: bool = False) -> int:
        """Return how many bytes of address space a forked command has when it begins."""
        sizes = Path(f"/proc/{self._started(lean).pid}/statm").read_text().split()
        return int(sizes[0]) * os.sysconf("SC_PAGE_SIZE")

    def environment(self, changed: Mapping[str, str] | None = None) -> dict[str, str]:
        """Return the variables of a command: one thread, a temporary folder of the harness, the code of `source`."""
        self.temporary.mkdir(parents=True, exist_ok=True)
        fixed = {"OMP_NUM_THREADS": "1", "TMPDIR": str(self.temporary), "PYTHONUNBUFFERED": "1"}
        if self.source is not None:
            fixed["PYTHONPATH"] = str(self.source)
        return {**os.environ, **fixed, **(changed or {})}

    def _started(self, lean: bool = False) -> "subprocess.Popen[str]":
        template = self._templates.get(lean)
        if template is None or template.poll() is not None:
            shim = {} if self.shim is None else {"LD_PRELOAD": str(self.shim)}
            template = self._templates[lean] = subprocess.Popen(
                [sys.executable, HERE / "template.py", *(["lean"] if lean else [])],
                env=self.environment(shim),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            assert template.stdout is not None
            if template.stdout.readline() != "ready\n":
                raise RuntimeError("the template process did not start")
        return template


def _remove_forsaken(cases: Path) -> None:
    """Remove cases of processes that were killed, and what was mounted in them."""
    for folder in cases.glob("[0-9]*"):
        if not Path("/proc", folder.name).exists():
            for line in Path("/proc/mounts").read_text().splitlines():
                place = line.split()[1].encode().decode("unicode_escape")
                if place.startswith(f"{folder}/"):
                    subprocess.run(["umount", "-l", place], capture_output=True)
            shutil.rmtree(folder, ignore_errors=True)


# Work that a command commits for good, file by file: no later start may do it again.
_COMMITTED = re.compile(r"(^|.*/)((shards|episodes)/[^/]+\.parquet|checkpoints/step-\d+/[^/]+|eval\.json)$")


class CommittedWork:
    """The work in a folder that is whole as in an unbroken run, which the next start must keep, not do again."""

    def __init__(self, folder: Path, unbroken: Mapping[str, str]) -> None:
        """Take note of it.

        Args:
            folder: where a command was broken off.
            unbroken: path in it -> SHA-256 of the file that an unbroken run leaves there.
        """
        self._folder = folder
        named = [name for name in unbroken if _COMMITTED.match(name) and (folder / name).is_file()]
        whole = {name for name in named if hashlib.sha256((folder / name).read_bytes()).hexdigest() == unbroken[name]}
        self._marks = {name: self._mark(name) for name in whole if self._is_committed(name, whole, unbroken)}

    @property
    def names(self) -> set[str]:
        """Paths of the files that must be kept."""
        return set(self._marks)

    def _is_committed(self, name: str, whole: set[str], unbroken: Mapping[str, str]) -> bool:
        """Return whether all that counts with a file is whole: a checkpoint's other files, a shard's entry."""
        path = self._folder / name
        if path.name == "eval.json":
            return True
        if path.parent.parent.name == "checkpoints":
            return all(other in whole for other in unbroken if other.startswith(f"{Path(name).parent}/"))
        manifest = path.parent.parent / "manifest.json"
        return manifest.is_file() and f'"{path.parent.name}/{path.name}"' in manifest.read_text(errors="replace")

    def _mark(self, name: str) -> tuple[int, int] | None:
        """Return what a file that is written anew, even with the same bytes, does not share with the old one."""
        try:
            found = (self._folder / name).stat()
        except OSError:
            return None
        return found.st_ino, found.st_mtime_ns

    def lost(self) -> Tried | None:
        """Return what was done again or is gone."""
        gone = next((name for name, mark in self._marks.items() if self._mark(name) != mark), None)
        return None if gone is None else Tried("lost", f"{gone}: was whole, and was made again or is gone")


def digest_of(folder: Path, but: Sequence[str] = ()) -> dict[str, str]:
    """Return path -> SHA-256 of all files of a folder, but for names in `but`; folders and links count as such."""
    found: dict[str, str] = {}
    for path in sorted(folder.rglob("*")):
        if not any(part in but for part in path.relative_to(folder).parts):
            name = str(path.relative_to(folder))
            if path.is_symlink():
                found[name] = f"link to {path.readlink()}"
            else:
                found[name] = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"
    return found


def code_digest(*files: Path) -> str:
    """Return one SHA-256 of the product's code and of files of the harness, with those that they name or import."""
    packages = [path.parent for path in ROOT.glob("*/__init__.py") if path.parent.name != "tests"]
    product = [path for folder in packages for path in folder.rglob("*") if path.suffix in (".py", ".html")]
    whole = hashlib.sha256()
    for path in sorted({*product, *_with_what_they_use(HERE / "harness.py", HERE / "system_calls.py", *files)}):
        whole.update(f"{path.relative_to(ROOT)}\0".encode() + path.read_bytes() + b"\0")
    return whole.hexdigest()[:16]


def _with_what_they_use(*files: Path) -> set[Path]:
    """Return files of this folder, those that they import, and those that they start or load, at all removes."""
    found, left = set[Path](), list(files)
    while left:
        path = left.pop()
        if path not in found and path.exists():
            found.add(path)
            text = path.read_text()
            named = [f"{module}.py" for module in re.findall(r"from tests\.faults\.(\w+) import", text)]
            left += [HERE / name for name in (*named, *re.findall(r"[\"'](\w+\.(?:py|c))[\"']", text))]
    return found


@dataclass
class Log:
    """All faults that were tried, one line of JSON each; one that was tried with other code counts as not tried."""

    path: Path
    tried: dict[Fault, tuple[str, Tried]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Read what is there."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.read()

    def read(self) -> None:
        """Read what is there, also what other processes have added; a line that a kill cut short is left out."""
        lines = self.path.read_text().split("\n")[:-1] if self.path.exists() else []
        for line in lines:
            try:
                values = json.loads(line)
            except ValueError:
                continue
            fault = Fault(values["kind"], values["command"], values["name"])
            self.tried[fault] = values["code"], Tried(values["outcome"], values["said"], values.get("cases", 1))

    def knows(self, fault: Fault, code: str) -> bool:
        """Return whether it was tried with this code."""
        return fault in self.tried and self.tried[fault][0] == code

    def add(self, fault: Fault, code: str, tried: Tried, seconds: float) -> None:
        """Append one."""
        self.tried[fault] = code, tried
        values = {"kind": fault.kind, "command": fault.command, "name": fault.name, "code": code}
        values |= {"outcome": tried.outcome, "said": tried.said, "seconds": round(seconds, 2), "cases": tried.cases}
        with self.path.open("a") as file:
            file.write(f"\n{json.dumps(values)}\n")  # on a line of its own, whatever a kill has left there


@dataclass
class Results:
    """What became of the faults of a kind.

    Attributes:
        kind: its name.
        planned: how many faults it has.
        tried: those that were tried, now or before.
        why_not: why none can be tried on this machine; "" where they can.
    """

    kind: str
    planned: int = 0
    tried: list[tuple[Fault, Tried]] = field(default_factory=list)
    why_not: str = ""

    @property
    def whole(self) -> bool:
        """Whether all were tried."""
        return not self.why_not and len(self.tried) == self.planned


def try_kind(
    kind: Kind, work: Work, log: Log, code: str, short: bool, until: float, part: tuple[int, int] = (0, 1)
) -> Results:
    """Try the faults of a kind that were not tried yet; return what became of all.

    Args:
        kind: the kind.
        work: what they are tried on.
        log: of what was tried before; gets the others.
        code: see `code_digest`.
        short: see `Kind.faults`.
        until: when the clock (`time.monotonic`) says so, no other is begun; those of before are returned all the same.
        part: number and count of the parts that processes share them in.
    """
    results = Results(kind.name)
    mine, parts = part
    try:
        faults = list(kind.faults(work, short))
    except NotHereError as reason:
        results.why_not = str(reason)
        return results
    for fault in faults[mine::parts]:
        results.planned += 1
        if not log.knows(fault, code):
            if time.monotonic() > until:
                continue
            start = time.monotonic()
            try:
                tried = kind.tried(fault, work)
            except Exception as error:  # of the harness itself, which goes on with the others
                tried = Tried("traceback", f"of the harness: {type(error).__name__}: {error}")
            log.add(fault, code, tried, time.monotonic() - start)
            if tried.outcome not in GOOD:
                print(f"{fault.kind}, {fault.command}, {fault.name}: {tried.outcome}: {tried.said}", file=sys.stderr)
        results.tried.append((fault, log.tried[fault][1]))
    return results


def rows_of(results: Results) -> list[dict[str, Any]]:
    """Return a row for each command: how often it was tried, and what became of it; one row where nothing was tried."""
    empty = {"fault": results.kind, "command": "", "tried": 0} | dict.fromkeys(OUTCOMES, 0)
    rows: dict[str, dict[str, Any]] = {}
    for fault, one in results.tried:
        row = rows.setdefault(fault.command, empty | {"command": fault.command})
        row["tried"] += one.cases
        row[one.outcome] += one.cases
    return list(rows.values()) or [empty | {"command": f"not tried: {results.why_not or 'no time was left'}"}]


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the rows and their sum as a Markdown table."""
    columns = ("fault", "command", "tried", *OUTCOMES)
    kinds = len({row["fault"] for row in rows if row["tried"]})
    total = [f"all ({kinds} kinds)", "", *(sum(row[name] for row in rows) for name in columns[2:])]
    lines = [*([row[name] for name in columns] for row in rows), total]
    return markdown(columns, [[str(cell) for cell in line] for line in lines])


def sentence(results: Sequence[Results], day: str, code: str) -> str:
    """Return in words whether all that was planned was tried, when and with which code."""
    tried, planned = sum(len(one.tried) for one in results), sum(one.planned for one in results)
    said = f"{day}, code {code}: {tried:,} of {planned:,} faults that are planned were tried"
    left = [
        f"{one.kind}: {one.why_not or f'{len(one.tried):,} of {one.planned:,}'}" for one in results if not one.whole
    ]
    return f"{said}." if not left else f"**Not whole.** {said}. Not or not all tried: {'; '.join(left)}."
