"""What the scores of a study say of its rows: rates with intervals, differences on the same scenes, corrected for many.

Dimension key: S runs (training seeds) of a row, N scenes, O objects.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from graspq.evaluate.results_table import outcomes_of
from graspq.evaluate.statistics import SeveralRuns, holm, mean_success, object_counts, success_difference


@dataclass(frozen=True)
class Place:
    """What must agree for two scores to stand side by side.

    Attributes:
        task: name of the task.
        size: size of the dataset.
        setting: off-policy or on-policy.
        split: split of the object set.
    """

    task: str
    size: str
    setting: str
    split: str

    def __str__(self) -> str:
        return f"{self.task}, {self.size}, {self.setting}, {self.split}"


@dataclass(frozen=True)
class Scored:
    """The runs of one row at one place.

    Attributes:
        name: of the row.
        algo: its estimator.
        rows: of the table of scores, those that are done, one a seed.
        asked: how many runs there should be.
        failures: why runs failed, a line each.
        counts: objects in the scenes, float [N, O]; None where that is not known.
    """

    name: str
    algo: str
    rows: tuple[dict[str, Any], ...]
    asked: int
    failures: tuple[str, ...]
    counts: np.ndarray | None

    @cached_property
    def success(self) -> np.ndarray:
        """Outcome of each run in each scene, bool [S, N]."""
        return np.array([outcomes_of(row) for row in self.rows])

    @cached_property
    def mean(self) -> SeveralRuns:
        """Mean success with its interval over new runs, scenes and objects."""
        return mean_success(self.success, self.counts)

    @property
    def rates(self) -> list[float]:
        """The success rate of each run."""
        return [float(row["success_rate"]) for row in self.rows]

    def less(self, other: "Scored") -> SeveralRuns:
        """Return how much higher its mean success is than that of another row on the same scenes."""
        return success_difference(self.success, other.success, self.counts)


def scored_rows(table: Sequence[Mapping[str, Any]]) -> dict[Place, dict[str, Scored]]:
    """Return the rows of a table of scores by place and name, in the order of the table; those without a run not."""
    scenes = {(one["task"], one["split"]): object_counts(one["object_ids"]) for one in table if one["kind"] == "scenes"}
    grouped: dict[tuple[Place, str], list[dict[str, Any]]] = {}
    for one in table:
        if one["kind"] == "run":
            place = Place(one["task"], one["size"], one["setting"], one["split"])
            grouped.setdefault((place, one["row"]), []).append(dict(one))
    found: dict[Place, dict[str, Scored]] = {}
    for (place, name), some in grouped.items():
        done = [one for one in some if one["status"] == "done"]
        failures = tuple(f"seed {one['seed']}: {one['reason']}" for one in some if one["status"] == "failed")
        if done:
            counts = scenes.get((place.task, place.split))
            known = counts if counts is not None and len(counts) == done[0]["episodes"] else None
            row = Scored(name, done[0]["algo"], tuple(done), len(some), failures, known)
            found.setdefault(place, {})[name] = row
    return found


def trainings(table: Sequence[Mapping[str, Any]]) -> dict[Place, dict[str, list[tuple[str, float]]]]:
    """Return (name of the row, success rate) of every training by place and estimator; one that failed stands at 0."""
    found: dict[Place, dict[str, list[tuple[str, float]]]] = {}
    for one in table:
        if one["kind"] == "run" and one["status"] in ("done", "failed"):
            place = Place(one["task"], one["size"], one["setting"], one["split"])
            rate = float(one["success_rate"]) if one["status"] == "done" else 0.0
            found.setdefault(place, {}).setdefault(one["algo"], []).append((one["row"], rate))
    return found


@dataclass(frozen=True)
class Compared:
    """A row against another on the same scenes.

    Attributes:
        first: name of the row.
        second: name of the other.
        difference: first less second.
        p_value: of no difference, corrected (Holm) for all comparisons that it was made with.
    """

    first: str
    second: str
    difference: SeveralRuns
    p_value: float

    @property
    def better(self) -> bool:
        """Whether the first is better, at a level of 5 %."""
        return self.difference.value > 0 and self.p_value < 0.05

    @property
    def worse(self) -> bool:
        """Whether the first is worse, at a level of 5 %."""
        return self.difference.value < 0 and self.p_value < 0.05

    def __str__(self) -> str:
        one = self.difference
        p = f"{self.p_value:.3f}" if self.p_value >= 0.001 else "< 0.001"
        return f"{self.first} − {self.second}: {one.value:+.3f} ({one.low:+.3f} to {one.high:+.3f}), p {p}"


def compare(pairs: Sequence[tuple[Scored, Scored]]) -> list[Compared]:
    """Return the differences of pairs of rows, their p-values corrected for being so many."""
    differences = [first.less(second) for first, second in pairs]
    corrected = holm([one.p_value for one in differences])
    return [
        Compared(first.name, second.name, one, p)
        for (first, second), one, p in zip(pairs, differences, corrected, strict=True)
    ]


def against_the_best(rows: Mapping[str, Scored]) -> dict[str, Compared]:
    """Return every other row against the one of the highest mean, by name."""
    best = max(rows.values(), key=lambda one: one.mean.value)
    others = [one for one in rows.values() if one is not best and one.success.shape[1] == best.success.shape[1]]
    return {one.first: one for one in compare([(other, best) for other in others])}
