"""Divergence is seen at the step where it began, and values that no return can have count as divergence."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from graspq.train.loop import DivergedError, train
from graspq.train.progress import Progress
from graspq.train.run import Run
from graspq.train.settings import TrainSettings

Make = Callable[..., TrainSettings]


def logged(settings: TrainSettings, folder: Path, steps: list[tuple[float, float]]) -> tuple[int, str] | None:
    with Progress(Run(folder, {}), settings, 40, show=False) as progress:
        for loss, q in steps:
            with progress.timed():
                progress.count(torch.tensor(loss), {"Q": torch.tensor(q)})
        return progress.log(40 + len(steps), 0.1)


def test_values_of_the_tasks_size_are_logged(settings: Make, tmp_path: Path) -> None:
    assert logged(settings(), tmp_path, [(0.5, 1.2), (1.5, 9.9)]) is None
    assert [row["loss"] for row in Run(tmp_path, {}).metrics()] == [1.0]


@pytest.mark.parametrize(
    ("steps", "found"),
    [
        ([(0.1, 0.5), (0.1, 10.5), (0.1, 99.0)], (42, "mean |Q| is 10.5, and returns lie in [0, 1]")),
        ([(0.1, 0.5), (0.1, 0.5), (0.1, float("nan"))], (43, "mean |Q| is nan, and returns lie in [0, 1]")),
        ([(float("inf"), 99.0), (0.1, 0.5)], (41, "loss is not finite")),
    ],
)
def test_the_first_step_and_quantity_beyond_what_the_task_allows_are_named_and_no_row_is_written(
    settings: Make, tmp_path: Path, steps: list[tuple[float, float]], found: tuple[int, str]
) -> None:
    assert logged(settings(), tmp_path, steps) == found
    assert Run(tmp_path, {}).metrics() == []


@pytest.mark.parametrize(
    ("algo", "quantity"), [("mc", "Q"), ("dql", "Q|target"), ("ddpg", "Q|target"), ("pcl", "V|target")]
)
def test_a_run_whose_values_grow_out_of_reason_stops_and_keeps_the_checkpoint_before(
    settings: Make, tmp_path: Path, algo: str, quantity: str
) -> None:
    good = train(settings(algo, preset="paper", steps=1, out=tmp_path / "good")).checkpoint()
    chosen = settings(algo, preset="paper", steps=40, learning_rate=3.0, checkpoint_every=1, log_every=1)
    with pytest.raises(DivergedError, match=rf"^{algo} diverged at step \d+: the mean \|({quantity})\| is .*e?\d"):
        train(chosen)
    kept = Run.open(chosen.run_folder).latest_checkpoint()
    assert good.is_dir() and (kept is None or int(kept.name.removeprefix("step-")) < 40)
