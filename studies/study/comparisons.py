"""What the scores of a study say of its rows: rates with intervals, differences on the same scenes, corrected for many.

Dimension key: S runs (training seeds) of a row, N scenes, O objects.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from graspq.common.errors import UserError
from graspq.evaluate.results_table import outcomes_of
from graspq.evaluate.statistics import (
    CONFIDENCE,
    SeveralRuns,
    holm,
    mean_success,
    object_counts,
    success_difference,
)

# What all scores at a place must agree in, and besides it all runs of one row there; keys of the table of scores.
OF_A_PLACE = {"episodes": "numbers of episodes", "object_set_sha256": "object sets", "simulator": "simulator versions"}
OF_A_ROW = {"recipe_sha256": "recipes", "data_sha256": "datasets"}


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

    @classmethod
    def of(cls, run: Mapping[str, Any]) -> "Place":
        """Return the place of a line of the table of scores."""
        return cls(run["task"], run["size"], run["setting"], run["split"])

    def __str__(self) -> str:
        return f"{self.task}, {self.size}, {self.setting}, {self.split}"


@dataclass(frozen=True)
class Scored:
    """The runs of one row at one place.

    Attributes:
        name: of the row.
        algo: its estimator.
        rows: of the table of scores, those that are done, one a seed; there may be none.
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
        return self.mean_at(CONFIDENCE)

    def mean_at(self, confidence: float) -> SeveralRuns:
        """Return `mean` with an interval of another coverage, between 0 and 1."""
        return mean_success(self.success, self.counts, confidence)

    @property
    def several(self) -> bool:
        """Whether it has several runs: one says nothing of how much others would differ."""
        return len(self.rows) > 1

    @property
    def lacking(self) -> str:
        """How many of its trainings failed or are not done yet, in words; empty where all are done."""
        left = self.asked - len(self.rows) - len(self.failures)
        if self.failures:
            return f"{len(self.failures)} of {self.asked} trainings failed" + (f", {left} to do" if left else "")
        return f"{len(self.rows)} of {self.asked} trainings done" if left else ""

    @property
    def rates(self) -> list[float]:
        """The success rate of each run."""
        return [float(row["success_rate"]) for row in self.rows]

    def same_scenes(self, other: "Scored") -> bool:
        """Return whether another row met the same scenes: as many, of one object set, in one simulator's version."""
        return all(self.rows[0].get(key) == other.rows[0].get(key) for key in OF_A_PLACE)

    def less(self, other: "Scored", confidence: float = CONFIDENCE) -> SeveralRuns:
        """Return how much higher its mean success is than that of another row on the same scenes."""
        return success_difference(self.success, other.success, self.counts, confidence)


def asked_rows(table: Sequence[Mapping[str, Any]]) -> dict[Place, dict[str, Scored]]:
    """Return the rows of a table of scores by place and name, in the order of the table, those that were not begun too.

    Raises:
        UserError: runs under one name have two recipes or datasets, or a seed twice; or runs at one place were scored
            on different scenes.
    """
    scenes = objects_in_scenes(table)
    grouped: dict[Place, dict[str, list[Mapping[str, Any]]]] = {}
    for one in table:
        if one["kind"] == "run":
            grouped.setdefault(Place.of(one), {}).setdefault(one["row"], []).append(one)
    found: dict[Place, dict[str, Scored]] = {}
    for place, here in grouped.items():
        for name, some in here.items():
            _require_one_row(place, name, some)
            done = tuple(dict(one) for one in some if one["status"] == "done")
            failures = tuple(f"seed {one['seed']}: {one['reason']}" for one in some if one["status"] == "failed")
            counts = scenes.get((place.task, place.split, done[0]["episodes"])) if done else None
            row = Scored(name, some[0]["algo"], done, len(some), failures, counts)
            found.setdefault(place, {})[name] = row
        _require_same_scenes(place, [row for row in found[place].values() if row.rows])
    return found


def objects_in_scenes(table: Sequence[Mapping[str, Any]]) -> dict[tuple[str, str, int], np.ndarray]:
    """Return how often each object lies in each scene, [N, O], by task, split and number of scenes."""
    return {
        (one["task"], one["split"], len(one["object_ids"])): object_counts(one["object_ids"])
        for one in table
        if one["kind"] == "scenes"
    }


def _require_one_row(place: Place, name: str, runs: Sequence[Mapping[str, Any]]) -> None:
    for key, what in OF_A_ROW.items():
        known = {one[key]: one["study"] for one in runs if one.get(key) is not None}
        if len(known) > 1:
            told = ", ".join(f"{digest[:8]} of study {study}" for digest, study in known.items())
            raise UserError(
                f"row {name!r} ({place}): expected runs of one recipe and dataset, got {len(known)} {what} ({told}); "
                "give one of them a name of its own in its plan, or leave it out of --beside"
            )
    seeds = [one["seed"] for one in runs]
    twice = next((seed for seed in seeds if seeds.count(seed) > 1), None)
    if twice is not None:
        raise UserError(f"row {name!r} ({place}): seed {twice} stands there twice; leave one out of --beside")


def _require_same_scenes(place: Place, rows: Sequence[Scored]) -> None:
    for key, what in OF_A_PLACE.items():
        known = {str(one.get(key)): f"{row.name!r} of study {one['study']}" for row in rows for one in row.rows}
        if len(known) > 1:
            told = ", ".join(f"{value[:24]} with row {row}" for value, row in known.items())
            raise UserError(
                f"{place}: expected scores on the same scenes, got {len(known)} {what} ({told}); score one of them "
                "again, or leave it out of --beside"
            )


def scored_rows(table: Sequence[Mapping[str, Any]]) -> dict[Place, dict[str, Scored]]:
    """Return those of `asked_rows` that have a run that is done.

    Raises:
        UserError: as `asked_rows` does.
    """
    done = {place: {name: row for name, row in here.items() if row.rows} for place, here in asked_rows(table).items()}
    return {place: here for place, here in done.items() if here}


def trainings(table: Sequence[Mapping[str, Any]]) -> dict[Place, dict[str, list[tuple[str, float]]]]:
    """Return (name of the row, success rate) of every training by place and estimator; one that failed stands at 0."""
    found: dict[Place, dict[str, list[tuple[str, float]]]] = {}
    for one in table:
        if one["kind"] == "run" and one["status"] in ("done", "failed"):
            rate = float(one["success_rate"]) if one["status"] == "done" else 0.0
            found.setdefault(Place.of(one), {}).setdefault(one["algo"], []).append((one["row"], rate))
    return found


@dataclass(frozen=True)
class Compared:
    """A row against another on the same scenes.

    Attributes:
        first: name of the row.
        second: name of the other.
        difference: first less second.
        widened: the same, with an interval so wide that all of as many hold together (Bonferroni).
        p_value: of no difference, corrected (Holm) for all comparisons that it was made with.
    """

    first: str
    second: str
    difference: SeveralRuns
    widened: SeveralRuns
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
        return f"{self.first} − {self.second}: {difference_text(self.difference)}, p {p_text(self.p_value)}"


def difference_text(difference: SeveralRuns) -> str:
    """Return a difference of success rates with its interval, for a table."""
    return f"{difference.value:+.3f} ({difference.low:+.3f} to {difference.high:+.3f})"


def p_text(p_value: float) -> str:
    """Return a p-value for a table."""
    return f"{p_value:.3f}" if p_value >= 0.001 else "< 0.001"


def compare(pairs: Sequence[tuple[Scored, Scored]]) -> list[Compared]:
    """Return the differences of pairs of rows, their p-values corrected for being so many."""
    differences = [first.less(second) for first, second in pairs]
    widened = [first.less(second, widened_confidence(len(pairs))) for first, second in pairs]
    corrected = holm([one.p_value for one in differences])
    return [
        Compared(first.name, second.name, one, wide, p)
        for (first, second), one, wide, p in zip(pairs, differences, widened, corrected, strict=True)
    ]


def widened_confidence(count: int) -> float:
    """Return the coverage that each of `count` intervals needs, so that all hold together at 95 % (Bonferroni)."""
    return 1 - (1 - CONFIDENCE) / max(count, 1)


def reference_row(rows: Mapping[str, Scored], name: str | None = None) -> Scored:
    """Return the row that others are compared with: that of a name, else of the highest mean.

    One whose trainings are all done comes before one that lacks some, and that before one of which some failed: seeds
    that are left are no chance sample.

    Args:
        rows: of one place, by name.
        name: see above; the best, too, where no row is called so.
    """
    return rows.get(name or "") or max(
        rows.values(), key=lambda row: (not row.lacking, not row.failures, row.mean.value)
    )


def against(rows: Mapping[str, Scored], reference: str | None = None) -> dict[str, Compared]:
    """Return every other row against `reference_row`, by name, where either has several runs and lacks none.

    Where the row was picked by these same scores the p-values are corrected for all pairs of rows, any of which might
    have been the one with the best: corrected for the pairs with the best alone, one table of equal rows in eight
    would raise a false alarm.

    Args:
        rows: of one place, by name.
        reference: name of the row, where it was named beforehand.
    """
    one = reference_row(rows, reference)
    if one.lacking or not one.several:
        return {}
    others = [row for row in rows.values() if row.several and not row.lacking and row is not one]
    pairs = [(other, one) for other in others]
    if one.name != reference:
        pairs += itertools.combinations(others, 2)
    return {found.first: found for found in compare(pairs)[: len(others)]}


def unequal_steps(rows: Mapping[str, Scored]) -> bool:
    """Return whether the rows of the paper's preset had unequal numbers of steps, so that none tells of another."""
    runs = [row.rows[0] for row in rows.values()]
    return len({one["steps"] for one in runs if one["options"].get("preset") == "paper"}) > 1
