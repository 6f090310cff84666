"""What a report is made of: the runs and evaluations found in some folders, a score for each policy.

Nothing here imports PyTorch or PyBullet: a report can be made on a machine that has neither.
"""

import json
import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from graspq.common.checksums import DamagedError
from graspq.common.errors import UserError
from graspq.evaluate.records import (
    EPISODES_FILE,
    EVAL_FILE,
    ORACLE,
    RANDOM,
    EpisodeRow,
    Evaluation,
    find_evaluations,
    identity_digest,
)
from graspq.evaluate.statistics import wilson_interval
from graspq.report.stability import Sweep, all_left_out, find_sweeps
from graspq.train.run import Run

RUN_FILE = "config.json"
REFERENCES = (RANDOM, ORACLE)
Scene = tuple[int, int, tuple[str, ...]]
"""Seed of an evaluation, index of the episode, the objects in the bin."""


class PanelKey(NamedTuple):
    """What must agree for two success rates to stand side by side.

    Attributes:
        task: name of the task.
        split: split of the object set.
        objects: SHA-256 of the object set.
        settings: SHA-256 of the task's settings.
    """

    task: str
    split: str
    objects: str
    settings: str


@dataclass(frozen=True)
class RunData:
    """A training run as its folder tells it.

    Attributes:
        folder: the run's folder.
        name: what the report calls it.
        config: the content of `config.json`.
        metrics: the rows of `metrics.jsonl`, in order.
    """

    folder: Path
    name: str
    config: dict[str, Any]
    metrics: list[dict[str, Any]]

    @property
    def settings(self) -> dict[str, Any]:
        """Return the training settings."""
        settings = self.config.get("settings", {})
        return settings if isinstance(settings, dict) else {}

    def curve(self, *names: str) -> list[tuple[float, float]]:
        """Return (step, value) of a metric, `("loss",)` or `("validation", "loss")`, where it is a finite number."""
        points = []
        for row in self.metrics:
            value: Any = row
            for name in names:
                value = value.get(name) if isinstance(value, dict) else None
            if isinstance(value, int | float) and math.isfinite(value):
                points.append((float(row.get("step", 0)), float(value)))
        return points

    def validation_at(self, step: int) -> dict[str, Any] | None:
        """Return the numbers of the validation at a step, or None."""
        found = [row["validation"] for row in self.metrics if row.get("step") == step and "validation" in row]
        return found[-1] if found and isinstance(found[-1], dict) else None

    def last_validation(self) -> dict[str, Any] | None:
        """Return the last validation row's numbers, or None."""
        found = [row["validation"] for row in self.metrics if isinstance(row.get("validation"), dict)]
        return found[-1] if found else None


@dataclass(frozen=True)
class Score:
    """One policy's result on one task and split, pooled over the seeds of the scenes.

    Attributes:
        name: what the report calls the policy.
        policy: `random`, `oracle`, a user's `module:factory`, or None for a run.
        evaluations: one for each seed of the scenes.
    """

    name: str
    policy: str | None
    evaluations: tuple[Evaluation, ...]

    @property
    def episodes(self) -> int:
        """Return the number of episodes."""
        return sum(int(one.summary["episodes"]) for one in self.evaluations)

    @property
    def successes(self) -> int:
        """Return the number of successes."""
        return sum(int(one.summary["successes"]) for one in self.evaluations)

    @property
    def rate(self) -> float:
        """Return the success rate."""
        return self.successes / self.episodes

    @property
    def interval(self) -> tuple[float, float]:
        """Return Wilson's 95 % interval."""
        return wilson_interval(self.successes, self.episodes)

    @property
    def is_reference(self) -> bool:
        """Return whether it is an end of the scale rather than a candidate."""
        return self.policy in REFERENCES

    @cached_property
    def rows(self) -> list[EpisodeRow]:
        """Return the rows of all episodes; none where they are missing."""
        found: list[EpisodeRow] = []
        for evaluation in self.evaluations:
            if (evaluation.folder / EPISODES_FILE).exists():
                found += evaluation.rows()
        return found

    @cached_property
    def outcomes(self) -> dict[Scene, bool]:
        """Return success by scene; scores of a panel share task, split and object set."""
        return {(row.seed, row.episode, row.object_ids): row.success for row in self.rows}


@dataclass(frozen=True)
class Findings:
    """All that a report shows.

    Attributes:
        runs: training runs, in the order they were found.
        panels: what their scores have in common → scores, the references at the ends.
        sweeps: sweeps of many runs; of these runs, `runs` and `panels` hold the best of each estimator.
        evaluations: every evaluation that a score uses.
    """

    runs: list[RunData]
    panels: dict[PanelKey, list[Score]]
    sweeps: list[Sweep] = field(default_factory=list)

    @property
    def evaluations(self) -> list[Evaluation]:
        """Return the evaluations of all panels."""
        return [one for scores in self.panels.values() for score in scores for one in score.evaluations]


def gather(folders: Sequence[Path], baselines: Path | None) -> Findings:
    """Find the runs and evaluations at and below some folders.

    Args:
        folders: run folders, evaluations, sweeps, or folders that hold some of them.
        baselines: where else to look for evaluations of the random policy, the oracle and users' policies: those of
            tasks and splits that appear already, or all if none does.

    Raises:
        UserError: a folder is missing, or holds neither a run nor an evaluation.
        DamagedError: a file of one is not as it was written.
    """
    paths: dict[Path, None] = {}
    evaluations: dict[Path, Evaluation] = {}
    sweeps: dict[Path, Sweep] = {}
    for folder in folders:
        if not folder.is_dir():
            raise UserError(f"{folder}: no such folder; expected a run of grasp-train or an evaluation of grasp-eval")
        here = [path.parent for path in sorted(folder.rglob(RUN_FILE)) if _is_run(path.parent)]
        found = find_evaluations(folder)
        swept = find_sweeps(folder)
        if not here and not found and not swept:
            raise UserError(f"{folder}: neither a run of grasp-train ({RUN_FILE}) nor an evaluation ({EVAL_FILE}) here")
        paths.update({path.resolve(): None for path in here})
        evaluations.update({one.folder.resolve(): one for one in found})
        sweeps.update({one.folder.resolve(): one for one in swept})
    for left_out in all_left_out(list(sweeps.values())):
        paths.pop(left_out, None)
        evaluations = {path: one for path, one in evaluations.items() if left_out not in path.parents}
    if baselines is not None and baselines.is_dir():
        shown = {_panel_key(one) for one in evaluations.values()}
        for one in find_evaluations(baselines):
            if not shown or _panel_key(one) in shown:
                evaluations.setdefault(one.folder.resolve(), one)
    runs = [_read_run(path, name) for path, name in zip(paths, _names(list(paths)), strict=True)]
    panels = _panels(list(evaluations.values()), {run.folder: run.name for run in runs})
    return Findings(runs, panels, list(sweeps.values()))


def _panel_key(evaluation: Evaluation) -> PanelKey:
    summary = evaluation.summary
    settings = identity_digest(summary["job"].get("task", {}))
    return PanelKey(summary["task"], summary["split"], summary.get("object_set", {}).get("sha256", ""), settings)


def _names(paths: Sequence[Path]) -> list[str]:
    """Return the folders' names, with their parents' where the names alone are not distinct."""
    names = [path.name for path in paths]
    return [f"{path.parent.name}/{path.name}" if names.count(path.name) > 1 else path.name for path in paths]


def _is_run(folder: Path) -> bool:
    try:
        Run.open(folder)
    except DamagedError:
        raise
    except UserError:
        return False
    return True


def _read_run(folder: Path, name: str) -> RunData:
    run = Run.open(folder)
    return RunData(folder, name, run.config, run.metrics())


def _panels(evaluations: Sequence[Evaluation], names: dict[Path, str]) -> dict[PanelKey, list[Score]]:
    """Group evaluations by scenes, and within by policy; of two with the same seed the longer one counts."""
    grouped: dict[PanelKey, dict[tuple[str, str], dict[int, Evaluation]]] = defaultdict(dict)
    for one in evaluations:
        summary = one.summary
        settings = {**summary["job"], "seed": None, "episodes": None}
        key = (_run_name(one, names), json.dumps(settings, sort_keys=True))
        seeds = grouped[_panel_key(one)].setdefault(key, {})
        best = seeds.get(summary["seed"])
        if best is None or best.summary["episodes"] < summary["episodes"]:
            seeds[summary["seed"]] = one
    panels = {}
    for scenes, policies in sorted(grouped.items()):
        scores = [
            Score(name, next(iter(seeds.values())).summary["policy"], tuple(seeds[seed] for seed in sorted(seeds)))
            for (name, _), seeds in policies.items()
        ]
        ends = {RANDOM: 0, ORACLE: 2}
        panels[scenes] = sorted(scores, key=lambda score: (ends.get(score.policy or "", 1), score.rate, score.name))
    return panels


def _run_name(evaluation: Evaluation, names: dict[Path, str]) -> str:
    for parent in evaluation.folder.resolve().parents:
        if parent in names:
            return names[parent]
    return str(evaluation.summary["label"])


def calibration_of(rows: Iterable[EpisodeRow], bins: int = 10) -> list[tuple[float, float, int]]:
    """Return (mean Q of the last action, share of successes, episodes) of evaluated episodes in bins of Q."""
    pairs = np.array([(row.q, row.success) for row in rows if row.q is not None], dtype=float).reshape(-1, 2)
    places = np.clip((pairs[:, 0] * bins).astype(int), 0, bins - 1)
    return [
        (float(pairs[places == place, 0].mean()), float(pairs[places == place, 1].mean()), int(np.sum(places == place)))
        for place in np.unique(places)
    ]
