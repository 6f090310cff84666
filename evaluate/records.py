"""The files of one evaluation: `episodes.jsonl` (a row per episode), `films.npz` (some frames) and `eval.json`.

`eval.json` is written last and holds the digests of the others and its own checksum: an evaluation without it, or with
other files than it names, does not count as finished.
"""

import functools
import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from graspq.common.checksums import DamagedError, read_checked_json, write_checked_json
from graspq.common.errors import UserError
from graspq.common.files import sha256_of, write_text
from graspq.common.options import MOST

EVAL_FILE = "eval.json"
EPISODES_FILE = "episodes.jsonl"
FILMS_FILE = "films.npz"
FORMAT_VERSION = 2
REMEDY = "run grasp-eval --again"
# What eval.json calls policies: the two ends of the scale, and those of runs.
ORACLE, RANDOM, CEM, ACTOR = "oracle", "random", "cem", "actor"


def _words(value: Any) -> bool:
    return isinstance(value, str)


def _share(value: Any) -> bool:
    return type(value) in (int, float) and 0 <= value <= 1


def _count(value: Any) -> bool:
    return type(value) is int and 0 <= value <= MOST


def _entries(value: Any) -> bool:
    return isinstance(value, dict)


def _or_none(fits: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: value is None or fits(value)


# What eval.json holds, as far as tables and reports reckon with it, and what each must be.
_KINDS: dict[str, Callable[[Any], bool]] = {
    "task": _words, "split": _words, "label": _words, "seed": lambda value: type(value) is int,
    "policy": _or_none(_words), "successes": _count, "success_rate": _share,
    "episodes": lambda value: _count(value) and value > 0, "job": _entries, "files": _entries,
    "object_set": lambda value: _entries(value) and all(_words(value.get(name, "")) for name in ("name", "sha256")),
    "ci95": lambda value: isinstance(value, list) and len(value) == 2 and all(map(_share, value)),
    "mean_steps": lambda value: type(value) in (int, float), "versions": _entries,
    "ends": lambda value: _entries(value) and all(map(_count, value.values())), "cem": _or_none(_entries),
    "run": _or_none(_words), "algo": _or_none(_words), "checkpoint_step": _or_none(_count),
    "training_seed": _or_none(_count), "data_sha256": _or_none(_words), "recipe_sha256": _or_none(_words),
    "trained_by": _or_none(_words), "command": _words, "code_revision": _words,
}  # fmt: skip


@dataclass(frozen=True)
class EpisodeRow:
    """What happened in one episode.

    Attributes:
        episode: index within the evaluation, from 0.
        seed: the evaluation's seed; with `episode` it determines the scene.
        object_ids: the objects in the bin.
        success: whether the grasp counted.
        lifted_object: the object that was lifted; None if none was.
        steps: number of actions, 1 .. T.
        ended_by: `"height"` (the gripper came below the threshold) or `"T"` (the last step).
        episode_return: sum of rewards, undiscounted.
        q: Q-value of the last action, a probability of success; None where the policy has no Q-function.
    """

    episode: int
    seed: int
    object_ids: tuple[str, ...]
    success: bool
    lifted_object: str | None
    steps: int
    ended_by: str
    episode_return: float
    q: float | None

    def to_json(self) -> dict[str, Any]:
        """Return the row as plain JSON values; `episode_return` is called `return` there."""
        return {
            "episode": self.episode,
            "seed": self.seed,
            "object_ids": list(self.object_ids),
            "success": self.success,
            "lifted_object": self.lifted_object,
            "steps": self.steps,
            "ended_by": self.ended_by,
            "return": self.episode_return,
            "q": self.q,
        }

    @classmethod
    def from_json(cls, row: dict[str, Any]) -> "EpisodeRow":
        """Return the row that `to_json` wrote."""
        values = {**row, "object_ids": tuple(row["object_ids"]), "episode_return": row["return"]}
        values.pop("return")
        return cls(**values)


@dataclass(frozen=True)
class Evaluation:
    """A finished evaluation on disk.

    Attributes:
        folder: where its files are.
        summary: the content of `eval.json`.
    """

    folder: Path
    summary: dict[str, Any]

    @classmethod
    def load(cls, folder: Path) -> "Evaluation":
        """Read `eval.json` of a folder.

        Raises:
            UserError: it is missing or is no evaluation of this format.
            DamagedError: it is not as it was written.
        """
        path = folder / EVAL_FILE
        summary = read_checked_json(path, "evaluation", REMEDY)
        needed = ("format_version", "task", "split", "episodes", "successes", "success_rate", "ci95", "label", "job")
        missing = [name for name in needed if name not in summary]
        if missing:
            raise UserError(f"{path}: no evaluation of graspq ({missing[0]!r} is missing); run grasp-eval again")
        if summary["format_version"] != FORMAT_VERSION:
            found = summary["format_version"]
            raise UserError(f"{path}: format {found}, expected {FORMAT_VERSION}; run grasp-eval again")
        wrong = next((name for name, fits in _KINDS.items() if name in summary and not fits(summary[name])), None)
        if wrong is None and not summary["successes"] <= summary["episodes"]:
            wrong = "successes"
        if wrong is not None:
            raise DamagedError(f"{path}: {wrong} = {summary[wrong]!r} is none of an evaluation; {REMEDY}")
        return cls(folder, summary)

    def rows(self) -> list[EpisodeRow]:
        """Read the rows of all episodes, in the order of their index.

        Raises:
            DamagedError: the file is missing or is not the one that `eval.json` names.
        """
        path = self.folder / EPISODES_FILE
        if not self.has(EPISODES_FILE):
            raise DamagedError(f"{path}: damaged or missing, not the rows that {EVAL_FILE} names; {REMEDY}")
        try:
            return [EpisodeRow.from_json(json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines()]
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise DamagedError(f"{path}: not the rows of an evaluation ({error!r}); {REMEDY}") from None

    def names(self, name: str) -> bool:
        """Return whether `eval.json` names a file `name` beside it."""
        return name in self.summary.get("files", {})

    def has(self, name: str) -> bool:
        """Return whether the file `name` stands beside `eval.json` as it was written."""
        path = self.folder / name
        return self.names(name) and path.is_file() and self.summary["files"][name] == sha256_of(path)


def write_rows(folder: Path, rows: Sequence[EpisodeRow]) -> None:
    """Write `episodes.jsonl` atomically: one JSON object a line."""
    write_text(folder / EPISODES_FILE, "".join(json.dumps(row.to_json()) + "\n" for row in rows))


def write_summary(folder: Path, summary: dict[str, Any]) -> Evaluation:
    """Write `eval.json` with the digests of the files beside it; call it last."""
    names = [name for name in (EPISODES_FILE, FILMS_FILE) if (folder / name).is_file()]
    complete = {**summary, "files": {name: sha256_of(folder / name) for name in names}}
    write_checked_json(folder / EVAL_FILE, complete)
    return Evaluation(folder, complete)


def identity_digest(identity: dict[str, Any]) -> str:
    """Return the SHA-256 of a job's identity, 64 hexadecimal digits."""
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()


def find_evaluations(folder: Path) -> list[Evaluation]:
    """Return all evaluations at or below `folder`, in the order of their paths; those of other formats are left out.

    Raises:
        DamagedError: an `eval.json` is not as it was written.
    """
    found = []
    for path in sorted(folder.rglob(EVAL_FILE)):
        try:
            found.append(Evaluation.load(path.parent))
        except DamagedError:
            raise
        except UserError:
            continue
    return found


def finished_in(folder: Path) -> Evaluation | None:
    """Return the evaluation in a folder if it is there and finished; says so where it is there and damaged."""
    try:
        found = Evaluation.load(folder)
        found.rows()
    except DamagedError as error:
        _say_once(f"{error.message.partition('; ')[0]}: does not count as finished")
        return None
    except UserError:
        return None
    return found


@functools.cache
def _say_once(line: str) -> None:
    click.echo(line, err=True)


def finished_below(folder: Path) -> Iterator[Evaluation]:
    """Yield all finished evaluations at or below `folder`, in the order of their paths; see `finished_in`."""
    for path in sorted(folder.rglob(EVAL_FILE)):
        found = finished_in(path.parent)
        if found is not None:
            yield found
