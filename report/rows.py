"""The rows of a panel: runs of one recipe and data that differ in their training seed alone stand together as one.

Rates, intervals and differences are those of `evaluate/statistics.py`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from graspq.common.seeding import generator
from graspq.evaluate.over_seeds import FEWEST_SCENES, name_of_runs
from graspq.evaluate.records import ORACLE
from graspq.evaluate.statistics import (
    Interval,
    Profile,
    bootstrap_interval,
    holm,
    mean_success,
    object_counts,
    paired_difference,
    performance_profile,
    probability_of_improvement,
    success_difference,
)
from graspq.report.findings import Scene, Score


@dataclass(frozen=True)
class Row:
    """Policies that a panel shows as one.

    Attributes:
        name: what the report calls it.
        scores: of its runs, in the order of their training seeds; a single one for a policy without a run.
        scenes: those that all of them met, in order.
    """

    name: str
    scores: tuple[Score, ...]
    scenes: tuple[Scene, ...]

    @cached_property
    def success(self) -> npt.NDArray[np.bool_]:
        """Return the outcome of each run in each of the scenes, bool [S, N]."""
        return self.in_scenes(self.scenes)

    def in_scenes(self, scenes: Sequence[Scene]) -> npt.NDArray[np.bool_]:
        """Return the outcome of each run in some scenes that all met, bool [S, N]."""
        outcomes = [score.outcomes for score in self.scores]
        return np.array([[one[scene] for scene in scenes] for one in outcomes], dtype=np.bool_).reshape(-1, len(scenes))

    @property
    def several(self) -> bool:
        """Return whether it has several runs."""
        return len(self.scores) > 1

    @property
    def is_reference(self) -> bool:
        """Return whether it is an end of the scale rather than a candidate."""
        return self.scores[0].is_reference

    @cached_property
    def rate(self) -> Interval:
        """Return the success rate: over runs, scenes and objects, or Wilson's of a single run."""
        if not self.several:
            return Interval(self.scores[0].rate, *self.scores[0].interval)
        return mean_success(self.success, _counts(self.scenes))

    @cached_property
    def bootstrap(self) -> Interval:
        """Return the success rate with its bootstrap interval over runs and scenes."""
        return bootstrap_interval([self.success], generator("report/bootstrap", 0))

    def profile(self, thresholds: npt.NDArray[np.float64]) -> Profile:
        """Return its performance profile."""
        return performance_profile(self.success, thresholds, generator("report/profile", 0))

    def improvement(self, other: "Row") -> Interval | None:
        """Return the probability that a run of it is better than one of the other; None without common scenes."""
        common = _common(self, other)
        if len(common) < FEWEST_SCENES:
            return None
        rng = generator("report/improvement", 0)
        return probability_of_improvement(self.in_scenes(common), other.in_scenes(common), rng)


def rows_of(scores: Sequence[Score]) -> list[Row]:
    """Return the rows of a panel, the references at the ends, by success between them."""
    groups: dict[tuple[object, ...], list[Score]] = {}
    for score in scores:
        groups.setdefault(_recipe(score) or (id(score),), []).append(score)
    rows = []
    for group in groups.values():
        ordered = sorted(group, key=lambda score: int(score.evaluations[0].summary.get("training_seed") or 0))
        scenes = _shared([score.outcomes.keys() for score in ordered])
        seeds = [score.evaluations[0].summary.get("training_seed") for score in ordered]
        if len(ordered) > 1 and len(set(seeds)) == len(seeds) and len(scenes) >= FEWEST_SCENES:
            rows.append(Row(name_of_runs([score.name for score in ordered]), tuple(ordered), tuple(sorted(scenes))))
        else:
            rows += [Row(score.name, (score,), tuple(sorted(score.outcomes))) for score in ordered]
    ends = {"random": 0, ORACLE: 2}
    return sorted(rows, key=lambda row: (ends.get(row.scores[0].policy or "", 1), row.rate.value, row.name))


def best_of(rows: Sequence[Row]) -> Row | None:
    """Return the row of the highest rate, the references aside; None where there is none."""
    return max((row for row in rows if not row.is_reference), key=lambda row: row.rate.value, default=None)


def _recipe(score: Score) -> tuple[object, ...] | None:
    summary = score.evaluations[0].summary
    if summary.get("recipe_sha256") is None or summary.get("data_sha256") is None:
        return None
    return summary["recipe_sha256"], summary["data_sha256"], summary.get("checkpoint_step")


def _shared(keys: Sequence[object]) -> set[Scene]:
    sets: list[set[Scene]] = [set(one) for one in keys]  # type: ignore[call-overload]
    return set.intersection(*sets)


def _common(first: Row, second: Row) -> list[Scene]:
    return sorted(set(first.scenes) & set(second.scenes))


def _counts(scenes: Sequence[Scene]) -> npt.NDArray[np.float64]:
    return object_counts([scene[2] for scene in scenes])


@dataclass(frozen=True)
class Comparison:
    """The best row against another on the scenes that both met.

    Attributes:
        other: the other row.
        difference: success of the best less that of the other, with its interval.
        p_value: two-sided, that they are equal; McNemar's exact test for two single runs.
        adjusted: the same by Holm, over all comparisons of the panel.
        scenes: number of scenes.
    """

    other: Row
    difference: Interval
    p_value: float
    adjusted: float
    scenes: int


def comparisons(rows: Sequence[Row]) -> list[Comparison]:
    """Return the differences of the best row to all others but the oracle, nearest first, with Holm's correction."""
    best = best_of(rows)
    found: list[tuple[Row, Interval, float, int]] = []
    for other in sorted(rows, key=lambda row: -row.rate.value):
        if best is None or other is best or other.scores[0].policy == ORACLE:
            continue
        common = _common(best, other)
        if len(common) < FEWEST_SCENES:
            continue
        ours, theirs = best.in_scenes(common), other.in_scenes(common)
        if best.several or other.several:
            several = success_difference(ours, theirs, _counts(common))
            found.append((other, several, several.p_value, len(common)))
        else:
            pair = paired_difference(ours[0], theirs[0])
            found.append((other, Interval(pair.difference, pair.low, pair.high), pair.p_value, len(common)))
    adjusted = holm([p_value for _, _, p_value, _ in found])
    return [
        Comparison(other, difference, p_value, corrected, scenes)
        for (other, difference, p_value, scenes), corrected in zip(found, adjusted, strict=True)
    ]
