"""Runs that differ in their training seed alone as one line: their mean success over runs, scenes and objects."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graspq.common.text import aligned
from graspq.evaluate.records import Evaluation, identity_digest
from graspq.evaluate.statistics import SeveralRuns, mean_success, object_counts

FEWEST_SCENES = 2
# What agrees between evaluations of one line, besides simulator, task settings and object set.
SAME = ("recipe_sha256", "data_sha256", "checkpoint_step", "task", "split", "seed", "episodes")


@dataclass(frozen=True)
class OverSeeds:
    """Runs of one recipe on the same data, scored in the same scenes.

    Attributes:
        name: what tables call them.
        task: name of the task.
        split: split of the object set.
        training_seeds: of the runs, in order.
        rate: their mean success rate.
    """

    name: str
    task: str
    split: str
    training_seeds: tuple[int, ...]
    rate: SeveralRuns


def name_of_runs(names: Sequence[str]) -> str:
    """Return the names of runs without their seeds where that is one name, else the first and how many follow."""
    short = {re.sub(r"[-_.]?seed\d+$", "", name) for name in names}
    return short.pop() if len(short) == 1 and short != {""} else f"{names[0]} and {len(names) - 1} more"


def over_seeds(evaluations: Sequence[Evaluation]) -> list[OverSeeds]:
    """Return a line for each recipe of which several training seeds were scored, in the order of the first of each.

    Evaluations of the same run and checkpoint, of a single scene, or that do not name their recipe are on no line.

    Raises:
        UserError: the rows of an evaluation's episodes are missing.
    """
    groups: dict[tuple[object, ...], list[Evaluation]] = {}
    for one in evaluations:
        named = all(one.summary.get(name) is not None for name in ("recipe_sha256", "training_seed"))
        if named and one.summary["episodes"] >= FEWEST_SCENES:
            scenes = {name: one.summary["job"].get(name) for name in ("simulator", "task", "object_set")}
            key = (*(one.summary.get(name) for name in SAME), identity_digest(scenes))
            groups.setdefault(key, []).append(one)
    return [_line(group) for group in groups.values() if len({_seed(one) for one in group}) == len(group) > 1]


def _seed(evaluation: Evaluation) -> int:
    return int(evaluation.summary["training_seed"])


def _line(group: Sequence[Evaluation]) -> OverSeeds:
    runs = sorted(group, key=_seed)
    rows = [one.rows() for one in runs]
    success = np.array([[row.success for row in of_run] for of_run in rows])
    rate = mean_success(success, object_counts([row.object_ids for row in rows[0]]))
    summary, names = runs[0].summary, [str(one.summary["label"]) for one in runs]
    return OverSeeds(name_of_runs(names), summary["task"], summary["split"], tuple(map(_seed, runs)), rate)


def lines_over_seeds(found: Sequence[OverSeeds]) -> str:
    """Return a table for the terminal, best first; empty where there is nothing."""
    rows = [
        (
            one.name,
            f"{one.task} {one.split}",
            f"{len(one.training_seeds)} training seeds",
            f"{100 * one.rate.value:.1f} %",
            f"95 %: {100 * one.rate.low:.1f} to {100 * one.rate.high:.1f}",
        )
        for one in sorted(found, key=lambda one: -one.rate.value)
    ]
    return aligned(rows) if rows else ""
