"""What a training run tells while it runs: the progress bar, `metrics.jsonl` and TensorBoard.

Losses stay on their device until a row is logged, so that a GPU never waits for them.
"""

import contextlib
import math
import sys
import time
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from graspq.train.run import Run
from graspq.train.settings import TrainSettings
from graspq.train.validation import Validation

# Of mean absolute values of returns, which lie in [0, 1]. Its square is that of the loss: where Q is a probability it
# cannot leave its range, but the outputs behind it can.
LARGEST = 10.0


class Progress:
    """Collects losses and times between two rows of metrics; a context manager."""

    def __init__(self, run: Run, settings: TrainSettings, step: int, show: bool) -> None:
        # Imported here: it takes a second, and most users of this module's neighbours do not need it.
        from torch.utils.tensorboard import SummaryWriter

        self._run, self._batch_size = run, settings.batch_size
        folder = str(run.folder / "tensorboard")
        self._writer = SummaryWriter(folder, purge_step=step + 1) if run.writes else None
        # A log file gets a line every half minute instead of a moving bar.
        interval = 0.5 if sys.stderr.isatty() else 30.0
        self._bar = tqdm(
            total=settings.steps,
            initial=step,
            desc=settings.algo,
            unit="step",
            disable=not show,
            mininterval=interval,
            maxinterval=2 * interval,
            dynamic_ncols=True,
        )
        self._shown: dict[str, str] = {}
        self._losses: list[Tensor] = []
        self._watched: dict[str, list[Tensor]] = {}
        self._first = step + 1
        self._seconds = 0.0

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()
        if self._writer is not None:
            self._writer.close()

    @contextlib.contextmanager
    def timed(self) -> Iterator[None]:
        """Count the time inside as training time."""
        start = time.perf_counter()
        yield
        self._seconds += time.perf_counter() - start

    def count(self, loss: Tensor, watched: Mapping[str, Tensor]) -> None:
        """Note a step that was taken: its loss, and mean absolute values that the task keeps near [0, 1], by name."""
        self._losses.append(loss)
        for name, value in watched.items():
            self._watched.setdefault(name, []).append(value.detach())
        self._bar.update(1)

    def log(self, step: int, learning_rate: float) -> tuple[int, str] | None:
        """Write a row for the steps since the last one, unless they diverged.

        Returns:
            The first step that diverged and what was found there, else None. Returns lie in [0, 1]: a mean beyond ±10
            is no estimate of one, nor is one whose loss is beyond ±100.
        """
        if not self._losses:
            return None
        start = time.perf_counter()
        losses = torch.stack(self._losses).cpu()
        self._seconds += time.perf_counter() - start
        diverged = self._diverged(losses)
        if diverged is not None:
            return diverged
        rate = len(losses) * self._batch_size / self._seconds
        row = {
            "step": step,
            "loss": float(losses.mean()),
            "samples_per_second": round(rate, 1),
            "learning_rate": learning_rate,
        }
        self._run.append_metrics(row)
        self._to_tensorboard("train", {name: value for name, value in row.items() if name != "step"}, step)
        self._show({"loss": f"{row['loss']:.4f}", "samples/s": f"{rate:.0f}"})
        self._losses, self._first, self._seconds = [], step + 1, 0.0
        self._watched = {}
        return None

    def _diverged(self, losses: Tensor) -> tuple[int, str] | None:
        watched = {name: torch.stack(values).cpu() for name, values in self._watched.items()}
        for index, loss in enumerate(losses.tolist()):
            if not math.isfinite(loss):
                return self._first + index, "loss is not finite"
            for name, values in watched.items():
                value = float(values[index])
                if not abs(value) <= LARGEST:
                    return self._first + index, f"mean |{name}| is {value:.3g}, and returns lie in [0, 1]"
            if abs(loss) > LARGEST**2:
                return self._first + index, f"loss is {loss:.3g}, and returns lie in [0, 1]"
        return None

    def log_validation(self, step: int, result: Validation) -> None:
        """Write a row of validation."""
        values = result.to_json()
        self._run.append_metrics({"step": step, "validation": values})
        self._to_tensorboard("validation", values, step)
        shown = {"held-back": f"{result.loss:.4f}"}
        if result.roc_auc_last_step is not None:
            shown["AUC"] = f"{result.roc_auc_last_step:.3f}"
        self._show(shown)

    def _to_tensorboard(self, group: str, values: dict[str, Any], step: int) -> None:
        for name, value in values.items():
            if self._writer is not None and isinstance(value, int | float):
                self._writer.add_scalar(f"{group}/{name}", value, step)

    def _show(self, values: dict[str, str]) -> None:
        self._shown |= values
        self._bar.set_postfix(self._shown, refresh=False)
