"""The files of one evaluation: `episodes.jsonl` (a row per episode), `films.npz` (some frames) and `eval.json`.

`eval.json` is written last and holds the digests of the others: an evaluation without it, or with other files than
it names, does not count as finished.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graspq.common.errors import UserError
from graspq.common.files import read_json, sha256_of, write_json, write_text

EVAL_FILE = "eval.json"
EPISODES_FILE = "episodes.jsonl"
FILMS_FILE = "films.npz"
FORMAT_VERSION = 2
# What eval.json calls policies: the two ends of the scale, and those of runs.
ORACLE, RANDOM, CEM, ACTOR = "oracle", "random", "cem", "actor"


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
        """
        path = folder / EVAL_FILE
        summary = read_json(path, "evaluation")
        needed = ("format_version", "task", "split", "episodes", "successes", "success_rate", "ci95", "label", "job")
        missing = [name for name in needed if not isinstance(summary, dict) or name not in summary]
        if missing:
            raise UserError(f"{path}: no evaluation of graspq ({missing[0]!r} is missing); run grasp-eval again")
        if summary["format_version"] != FORMAT_VERSION:
            found = summary["format_version"]
            raise UserError(f"{path}: format {found}, expected {FORMAT_VERSION}; run grasp-eval again")
        return cls(folder, summary)

    def rows(self) -> list[EpisodeRow]:
        """Read the rows of all episodes, in the order of their index.

        Raises:
            UserError: the file is missing or is not the one that `eval.json` names.
        """
        path = self.folder / EPISODES_FILE
        if not self.has(EPISODES_FILE):
            raise UserError(f"{path}: not the rows of this evaluation; run grasp-eval --again")
        return [EpisodeRow.from_json(json.loads(line)) for line in path.read_text().splitlines()]

    def has(self, name: str) -> bool:
        """Return whether the file `name` stands beside `eval.json` as it was written."""
        path = self.folder / name
        return path.is_file() and self.summary.get("files", {}).get(name) == sha256_of(path)


def write_rows(folder: Path, rows: Sequence[EpisodeRow]) -> None:
    """Write `episodes.jsonl` atomically: one JSON object a line."""
    write_text(folder / EPISODES_FILE, "".join(json.dumps(row.to_json()) + "\n" for row in rows))


def write_summary(folder: Path, summary: dict[str, Any]) -> Evaluation:
    """Write `eval.json` with the digests of the files beside it; call it last."""
    names = [name for name in (EPISODES_FILE, FILMS_FILE) if (folder / name).is_file()]
    complete = {**summary, "files": {name: sha256_of(folder / name) for name in names}}
    write_json(folder / EVAL_FILE, complete)
    return Evaluation(folder, complete)


def identity_digest(identity: dict[str, Any]) -> str:
    """Return the SHA-256 of a job's identity, 64 hexadecimal digits."""
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()


def find_evaluations(folder: Path) -> list[Evaluation]:
    """Return all evaluations at or below `folder`, in the order of their paths; broken ones are left out."""
    found = []
    for path in sorted(folder.rglob(EVAL_FILE)):
        try:
            found.append(Evaluation.load(path.parent))
        except UserError:
            continue
    return found
