"""Single flipped bits in every kind of file, read by the command that uses it.

What counts as good: the command refuses and names the file, or says that it does without it and ends in the same bytes,
or what it gives is bit for bit what the whole file gives.
"""

import contextlib
import hashlib
import random
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.faults.commands import essence
from tests.faults.harness import Fault, Ran, Tried, Work, digest_of

TRAINING = (
    "--preset paper --width 4 --batch-size 8 --validation-fraction 0.3 --save-every 2 --device cpu --precision float32 "
    "--threads 1"
)
VERIFY = "grasp-data verify data/regular-24 --workers 0"
TRAIN = f"grasp-train --algo mc --shards data/regular-24 --out fresh --steps 1 {TRAINING}"
RESUME = f"grasp-train --algo mc --shards data/regular-24 --out runs/mc --steps 8 {TRAINING}"
LOAD = "grasp-eval runs/mc --episodes 2 --workers 0 --device cpu --out fresh --plan"
SET = "grasp-eval --policy random --episodes 2 --objects objects --workers 0 --out fresh"
REPORT_RUN = "grasp-report runs/mc --out fresh.html"
REPORT_SCORES = "grasp-report scores --out fresh.html"
RESCORE = "grasp-eval runs/mc --episodes 4 --films 1 --workers 0 --device cpu --out scores"
REPORT_SWEEP = "grasp-report sweep --out fresh.html"
PLAN_SWEEP = (
    "grasp-sweep --algo mc --shards data/regular-24 --learning-rate 0.001 --width 4 --seeds 1 --steps 4 --episodes 2 "
    "--vary batch_size=8 --threads 1 --workers 0 --device cpu --out sweep --dry-run"
)
FREEZE = "grasp-study freeze plan.toml --out study"
TABLE = "grasp-study report plan.toml --out elsewhere --results results --page fresh.md"


@dataclass(frozen=True)
class Reading:
    """A kind of file and the command that reads it.

    Attributes:
        what: it is, a name of faults.
        files: pattern of its files in a copy of the work; the first that is there is flipped.
        command: that reads it.
        needs: inputs that the command needs.
        flips: how many.
        repairs: the command makes the file again, so that it must be the same afterwards.
        found: the command is there to find every flip; what it gives does not come from the file.
    """

    what: str
    files: str
    command: str
    needs: tuple[str, ...]
    flips: int = 60
    repairs: bool = False
    found: bool = False


READINGS = (
    Reading("steps table", "data/regular-24/shards/*.parquet", VERIFY, ("dataset",), 120, found=True),
    Reading("episodes table", "data/regular-24/episodes/*.parquet", VERIFY, ("dataset",), 80, found=True),
    Reading("manifest", "data/regular-24/manifest.json", VERIFY, ("dataset",), 120),
    Reading("card", "data/regular-24/README.md", VERIFY, ("dataset",), 30, found=True),
    Reading("object set of a dataset", "data/regular-24/objects/object_set.json", VERIFY, ("dataset",), 40,
            found=True),
    Reading("OBJ of a dataset", "data/regular-24/objects/meshes/*.obj", VERIFY, ("dataset",), 40, found=True),
    Reading("URDF of a dataset", "data/regular-24/objects/meshes/*.urdf", VERIFY, ("dataset",), 40, found=True),
    Reading("steps table, trained on", "data/regular-24/shards/*.parquet", TRAIN, ("dataset",), 20),
    Reading("manifest, trained on", "data/regular-24/manifest.json", TRAIN, ("dataset",), 20),
    Reading("object set", "objects/object_set.json", SET, ("objects",), 80),
    Reading("digest of an object set", "objects/object_set.json.sha256", SET, ("objects",), 20),
    Reading("OBJ", "objects/meshes/*.obj", SET, ("objects",), 30),
    Reading("URDF", "objects/meshes/*.urdf", SET, ("objects",), 30),
    Reading("config.json", "runs/mc/config.json", REPORT_RUN, ("run",), 100),
    Reading("metrics.jsonl", "runs/mc/metrics.jsonl", REPORT_RUN, ("run",), 80),
    Reading("config.json, acted by", "runs/mc/config.json", LOAD, ("dataset", "run"), 20),
    Reading("state.json", "runs/mc/checkpoints/step-00000008/state.json", LOAD, ("dataset", "run"), 50),
    Reading("weights", "runs/mc/checkpoints/step-00000008/q.safetensors", LOAD, ("dataset", "run"), 50),
    Reading("optimizer", "runs/mc/checkpoints/step-00000008/optimizer-q.safetensors", RESUME, ("dataset", "run"), 8,
            repairs=True),
    Reading("state.json, resumed", "runs/mc/checkpoints/step-00000008/state.json", RESUME, ("dataset", "run"), 8,
            repairs=True),
    Reading("eval.json", "scores/*/eval.json", REPORT_SCORES, ("evaluation",), 100),
    Reading("episodes.jsonl", "scores/*/episodes.jsonl", REPORT_SCORES, ("evaluation",), 50),
    Reading("films.npz", "scores/*/films.npz", REPORT_SCORES, ("evaluation",), 50),
    Reading("eval.json, scored again", "scores/*/eval.json", RESCORE, ("dataset", "run", "evaluation"), 6,
            repairs=True),
    Reading("episodes.jsonl, scored again", "scores/*/episodes.jsonl", RESCORE, ("dataset", "run", "evaluation"), 6,
            repairs=True),
    Reading("sweep.jsonl", "sweep/sweep.jsonl", REPORT_SWEEP, ("sweep",), 40),
    Reading("plan.json", "sweep/plan.json", PLAN_SWEEP, ("dataset", "sweep"), 40),
    Reading("frozen recipe", "recipe.json", FREEZE, ("dataset", "study"), 40),
    Reading("scores of a study", "results/study-plan.jsonl", TABLE, ("dataset", "study"), 40),
)  # fmt: skip


SHORT = ("steps table", "weights")


class Bits:
    """The kind."""

    name = "bit"

    def __init__(self) -> None:
        """Have no copies yet."""
        self._readings = {one.what: one for one in READINGS}
        self._copies: dict[str, tuple[Path, Ran, dict[str, Any]]] = {}
        self._open = contextlib.ExitStack()

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return the flips of each file; of a few files one flip each in the short form."""
        for one in READINGS:
            if not short or one.what in SHORT:
                for number in range(1 if short else one.flips):
                    yield Fault(self.name, _named(one), f"{one.what} {number}")

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Flip, run, compare with what the whole file gives, and flip back."""
        what, _, number = fault.name.rpartition(" ")
        one = self._readings[what]
        if one.repairs:
            with work.copy(*one.needs) as case:
                whole = _outputs(case, one)
                path = _flipped(case, one, int(number))
                ran = work.forked(one.command.split(), case)
                return _judged(one, path, ran, ran, whole, _outputs(case, one))
        case, before, whole = self._whole(one, work)
        path = _place(case, one)
        content = path.read_bytes()
        try:
            _flipped(case, one, int(number))
            ran = work.forked(one.command.split(), case)
            return _judged(one, path, before, ran, whole, _outputs(case, one))
        finally:
            path.write_bytes(content)

    def _whole(self, one: Reading, work: Work) -> tuple[Path, Ran, dict[str, Any]]:
        """Return a copy to flip bits in, and what the command gives with the whole file."""
        if one.what not in self._copies:
            self._open.close()  # one copy at a time
            self._copies.clear()
            case = self._open.enter_context(work.copy(*one.needs))
            before = work.forked(one.command.split(), case)
            if before.rc != 0:
                raise RuntimeError(f"{one.command}: {before.stderr}")
            self._copies[one.what] = case, before, _outputs(case, one)
        return self._copies[one.what]


def _named(one: Reading) -> str:
    return " ".join(one.command.split()[: 2 if one.command.startswith(("grasp-data ", "grasp-study")) else 1])


def _place(case: Path, one: Reading) -> Path:
    return sorted(case.glob(one.files))[0]


def _flipped(case: Path, one: Reading, number: int) -> Path:
    """Flip bit `number` of those that are drawn for this file; the first is in its first byte, the next in its last."""
    path = _place(case, one)
    content = bytearray(path.read_bytes())
    drawn = random.Random(f"{one.what} {number}")
    place = {0: 0, 1: len(content) - 1}.get(number, drawn.randrange(len(content)))
    content[place] ^= 1 << drawn.randrange(8)
    path.write_bytes(content)
    return path


def _outputs(case: Path, one: Reading) -> dict[str, Any]:
    """Return the digests of what the command writes, which is then removed where it is not the work itself."""
    if one.repairs:
        return essence(case)
    found = {}
    for path in sorted(case.glob("fresh*")):
        if path.is_dir():
            checkpoints = {name: digest for name, digest in digest_of(path).items() if name.endswith("safetensors")}
            found |= checkpoints or digest_of(path)
            for part in sorted(path.rglob("*"), reverse=True):
                part.rmdir() if part.is_dir() else part.unlink()
            path.rmdir()
        else:
            found[path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
            path.unlink()
    return found


def _judged(one: Reading, path: Path, before: Ran, ran: Ran, whole: dict[str, Any], now: dict[str, Any]) -> Tried:
    broken = ran.broken()
    if broken is not None:
        return broken
    names_it = path.name in ran.stderr
    if ran.rc != 0 or one.found:
        return ran.refused(path.name)
    if now != whole:
        differing = [name for name in {**whole, **now} if whole.get(name) != now.get(name)]
        return Tried("silently wrong", f"exit status 0, {differing[:3]} are others: {ran.line}")
    if one.repairs and not names_it and path.parent.name not in ran.stderr:
        return Tried("silently wrong", f"made again without a word of {path.name}: {ran.line}")
    if ran.stdout != before.stdout:
        return Tried("detected" if names_it else "silently wrong", ran.line if names_it else ran.stdout[-200:])
    return Tried("detected" if names_it else "survived", ran.line if names_it else "the same bytes")
