"""Files of trials as the commands write them, and a small but real dataset to run some on."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from graspq.evaluate.records import FORMAT_VERSION, EpisodeRow, write_rows, write_summary
from graspq.evaluate.statistics import wilson_interval
from graspq.objects.object_set import ObjectSet
from graspq.studies.sweep.settings import SweepSettings
from graspq.studies.sweep.trial import Trial
from graspq.train.run import Run, checkpoint_name
from graspq.train.search_settings import CemSettings

os.environ.setdefault("OMP_NUM_THREADS", "1")

DISCOUNTED = (("width", "32"), ("discount", "0.9"))


@pytest.fixture
def settings(tmp_path: Path) -> SweepSettings:
    return SweepSettings(shards=("data",), steps=100, episodes=10, threads=2, device="cpu", out=tmp_path).complete()


@pytest.fixture
def trials(settings: SweepSettings) -> list[Trial]:
    return [
        Trial(settings, "dql", (("learning_rate", "0.01"), *DISCOUNTED), 0),
        Trial(settings, "dql", (("learning_rate", "0.001"), *DISCOUNTED), 0),
        Trial(settings, "mc", (("learning_rate", "0.001"), ("width", "64")), 0),
    ]


def trained(trial: Trial, step: int, rows: tuple[dict[str, Any], ...] = ()) -> Run:
    """A run folder with its configuration, metrics and the newest checkpoint's folder."""
    config = {"settings": {"batch_size": 32}, "network": {}, "dataset": {}}
    run = Run.create_or_resume(trial.run_folder, config, frozenset())
    for row in rows:
        run.append_metrics(row)
    (run.checkpoints_folder / checkpoint_name(step)).mkdir(parents=True)
    return run


def scored(trial: Trial, successes: int, step: int = 100, episodes: int = 10, **changed: Any) -> Path:
    """An evaluation of a trial's run, by the real writers."""
    place = trial.run_folder / "evaluations" / f"regular-validation-seed0-{episodes}-{step}"
    place.mkdir(parents=True)
    rows = [EpisodeRow(index, 0, (), index < successes, None, 4, "height", 0.0, None) for index in range(episodes)]
    write_rows(place, rows)
    summary = {
        "format_version": FORMAT_VERSION, "task": "regular", "split": "validation", "episodes": episodes,
        "successes": successes, "success_rate": successes / episodes,
        "ci95": list(wilson_interval(successes, episodes)), "label": trial.name, "job": {}, "seed": 0,
        "checkpoint_step": step, "cem": CemSettings().to_json(), "policy": "cem",
    }  # fmt: skip
    write_summary(place, summary | changed)
    return place


@pytest.fixture
def write() -> Any:
    """The writers of a trial's files."""

    class Write:
        trained: Callable[..., Run] = staticmethod(trained)
        scored: Callable[..., Path] = staticmethod(scored)

    return Write


@pytest.fixture(scope="session")
def dataset(
    collect_regular: Callable[..., Path], regular_objects: ObjectSet, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Twelve grasps of the random policy."""
    return collect_regular(tmp_path_factory.mktemp("data") / "regular", regular_objects, 4, 3)
