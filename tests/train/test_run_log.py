"""Divergence is seen at the step where it began, and values that no return can have count as divergence."""

import re
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from graspq.train import loop, run_log
from graspq.train.checkpoint import load_acting
from graspq.train.loop import train
from graspq.train.networks.network import QNetwork
from graspq.train.run import Run
from graspq.train.run_log import RunLog
from graspq.train.session import DivergedError
from graspq.train.settings import TrainSettings

Make = Callable[..., TrainSettings]


def logged(settings: TrainSettings, folder: Path, steps: list[tuple[float, float]]) -> tuple[int, str] | None:
    with RunLog(Run(folder, {}), settings, 40, show=False, writes=True) as log:
        for loss, q in steps:
            with log.timed():
                log.count({"loss": torch.tensor(loss), "q": torch.tensor(q)})
        return log.log(40 + len(steps), 0.1)


def test_values_of_the_tasks_size_are_logged(settings: Make, tmp_path: Path) -> None:
    assert logged(settings(), tmp_path, [(0.5, 1.2), (1.5, 9.9)]) is None
    assert [row["loss"] for row in Run(tmp_path, {}).metrics()] == [1.0]


@pytest.mark.parametrize(
    ("steps", "found"),
    [
        ([(0.1, 0.5), (0.1, 10.5), (0.1, 99.0)], (42, "mean |q| is 10.5, and returns lie in [0, 1]")),
        ([(0.1, 0.5), (0.1, 0.5), (0.1, float("nan"))], (43, "mean |q| is not finite")),
        ([(float("inf"), 99.0), (0.1, 0.5)], (41, "loss is not finite")),
    ],
)
def test_the_first_step_and_quantity_beyond_what_the_task_allows_are_named_and_no_row_is_written(
    settings: Make, tmp_path: Path, steps: list[tuple[float, float]], found: tuple[int, str]
) -> None:
    assert logged(settings(), tmp_path, steps) == found
    assert Run(tmp_path, {}).metrics() == []


@pytest.mark.parametrize(
    ("algo", "quantity"), [("mc", "q"), ("dql", "q|target"), ("ddpg", "q|target"), ("pcl", "v|target")]
)
def test_a_run_whose_values_grow_out_of_reason_stops_and_keeps_the_checkpoint_before(
    settings: Make, monkeypatch: pytest.MonkeyPatch, algo: str, quantity: str
) -> None:
    # Three good steps, and a fourth after which no value is one of a return: the fifth finds them.
    monkeypatch.setattr(loop, "learning_rate", lambda settings, step: 1e-3 if step < 3 else 3.0)
    chosen = settings(algo, preset="paper", steps=40, save_every=1)
    with pytest.raises(DivergedError) as error:
        train(chosen)
    message = str(error.value)
    found = re.match(
        rf"{algo} diverged at step (\d+): the (?:loss|mean \|({quantity})\|) is \S+, and .*; (.+); ", message
    )
    assert found is not None, message
    loaded = load_acting(chosen.run_folder)
    assert loaded.step == 3 and int(found[1]) == 5
    assert found[3] == f"{loaded.checkpoint} is the last good checkpoint"
    image, step = torch.full((3, 16, 16, 3), 128, dtype=torch.uint8), torch.tensor([0, 1, 2])
    for network in loaded.networks.values():
        state = (image, step, torch.zeros(3, 4)) if isinstance(network, QNetwork) else (image, step)
        assert bool(network(*state).isfinite().all())


def test_tensorboards_thread_says_nothing_of_a_failure_that_its_caller_is_told_and_other_threads_do(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from tensorboard.summary.writer.event_file_writer import _AsyncWriter

    class Full:
        def write(self, data: bytes) -> None:
            raise OSError(28, "No space left on device")

        flush = close = lambda self: None

    monkeypatch.setattr(threading, "excepthook", run_log._all_but_writers)
    writer = _AsyncWriter(Full(), flush_secs=1)
    with pytest.raises(OSError, match="No space left"):
        for _ in range(100):
            writer.write(b"row")
            time.sleep(0.01)
    writer._worker.join()
    assert capsys.readouterr().err == ""
    other = threading.Thread(target=Full().write, args=(b"",))
    other.start()
    other.join()
    assert "No space left on device" in capsys.readouterr().err
