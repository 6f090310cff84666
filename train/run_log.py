"""What a training run tells while it runs: the progress bar, `metrics.jsonl` and TensorBoard.

Losses stay on their device until a row is logged, so that a GPU never waits for them.
"""

import contextlib
import math
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from graspq.common.errors import naming
from graspq.train.estimator import Metrics
from graspq.train.run import Run
from graspq.train.settings import TrainSettings
from graspq.train.validation import Validation

# Of what an update measures: means of absolute values that returns, which lie in [0, 1], keep near it, and the loss,
# which goes with their square: where Q is a probability it cannot leave its range, but the outputs behind it can.
BOUNDS = {"q": 10.0, "v": 10.0, "target": 10.0, "loss": 100.0}
LOG_EVERY = 50


def _all_but_writers(failed: threading.ExceptHookArgs) -> None:
    """Print what fails in a thread, but for TensorBoard's writer: that hands its failure on, and it is told as ours."""
    if not type(failed.thread).__module__.startswith("tensorboard."):
        threading.__excepthook__(failed)


class RunLog:
    """Collects losses and times between two rows of metrics; a context manager."""

    def __init__(self, run: Run, settings: TrainSettings, step: int, show: bool, writes: bool) -> None:
        # Imported here: it takes a second, and most users of this module's neighbours do not need it.
        from torch.utils.tensorboard import SummaryWriter

        self._run, self._batch_size, self._writes = run, settings.batch_size, writes
        self._folder = run.folder / "tensorboard"
        if threading.excepthook is threading.__excepthook__:
            threading.excepthook = _all_but_writers
        with naming(self._folder):
            self._writer = SummaryWriter(str(self._folder), purge_step=step + 1) if writes else None
        # A log file gets a line every half minute instead of a moving bar.
        interval = 0.5 if sys.stderr is not None and sys.stderr.isatty() else 30.0
        self._bar = tqdm(
            total=settings.last_step,
            initial=step,
            desc=settings.algo,
            unit="step",
            disable=not show,
            mininterval=interval,
            maxinterval=2 * interval,
            dynamic_ncols=True,
        )
        self._shown: dict[str, str] = {}
        self._measured: dict[str, list[Tensor]] = {}
        self._first = step + 1
        self._seconds = 0.0

    def __enter__(self) -> "RunLog":
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()
        if self._writer is not None:
            with naming(self._folder):
                self._writer.close()

    @contextlib.contextmanager
    def timed(self) -> Iterator[None]:
        """Count the time inside as training time."""
        start = time.perf_counter()
        yield
        self._seconds += time.perf_counter() - start

    def count(self, metrics: Metrics) -> None:
        """Note a step that was taken: its loss, and what else its update measured, by name."""
        for name, value in metrics.items():
            self._measured.setdefault(name, []).append(value.detach())
        self._bar.update(1)

    def log(self, step: int, learning_rate: float) -> tuple[int, str] | None:
        """Write a row for the steps since the last one, unless they diverged: means over these steps.

        Returns:
            The first step that diverged and what was found there, else None. Returns lie in [0, 1]: a mean beyond ±10
            is no estimate of one, nor is one whose loss is beyond ±100.
        """
        if not self._measured:
            return None
        start = time.perf_counter()
        measured = {name: torch.stack(values).cpu() for name, values in self._measured.items()}
        self._seconds += time.perf_counter() - start
        diverged = self._diverged(measured)
        if diverged is not None:
            return diverged
        rate = len(measured["loss"]) * self._batch_size / self._seconds
        row: dict[str, Any] = {"step": step, **{name: float(values.mean()) for name, values in measured.items()}}
        row |= {"samples_per_second": round(rate, 1), "learning_rate": learning_rate}
        self._write("train", row, {name: value for name, value in row.items() if name != "step"}, step)
        self._show({"loss": f"{row['loss']:.4f}", "samples/s": f"{rate:.0f}"})
        self._measured, self._first, self._seconds = {}, step + 1, 0.0
        return None

    def _diverged(self, measured: Metrics) -> tuple[int, str] | None:
        for index in range(len(measured["loss"])):
            for name, values in measured.items():
                value, what = float(values[index]), name if name == "loss" else f"mean |{name}|"
                if not math.isfinite(value):
                    return self._first + index, f"{what} is not finite"
                if abs(value) > BOUNDS.get(name, math.inf):
                    return self._first + index, f"{what} is {value:.3g}, and returns lie in [0, 1]"
        return None

    def log_validation(self, step: int, result: Validation) -> None:
        """Write a row of validation."""
        values = result.to_json()
        self._write("validation", {"step": step, "validation": values}, values, step)
        shown = {"held-back": f"{result.loss:.4f}"}
        if result.roc_auc_last_step is not None:
            shown["AUC"] = f"{result.roc_auc_last_step:.3f}"
        self._show(shown)

    def _write(self, group: str, row: dict[str, Any], values: dict[str, Any], step: int) -> None:
        if self._writer is None:
            return
        self._run.append_metrics(row)
        with naming(self._folder):
            for name, value in values.items():
                if isinstance(value, int | float):
                    self._writer.add_scalar(f"{group}/{name}", value, step)

    def _show(self, values: dict[str, str]) -> None:
        self._shown |= values
        self._bar.set_postfix(self._shown, refresh=False)
