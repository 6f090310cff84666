"""The training loop: batches in the sampler's order, one update each, validation, metrics and checkpoints.

Every step is a function of the settings, the step and the state before it, so that a run that was stopped at any moment
and started again ends in the same weights: bit for bit on a CPU with the same number of threads, and as far as the
driver's kernels are deterministic on a GPU.
"""

import dataclasses
import itertools
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any, cast

import torch
from torch import Tensor

from graspq.common.errors import UserError
from graspq.common.provenance import code_revision, versions
from graspq.datasets.batch import EpisodeBatch, TransitionBatch
from graspq.datasets.dataset import ShardPool, open_shards
from graspq.datasets.loader import EpisodeLoader, TransitionLoader, episode_batches, transition_batches
from graspq.train.augment import Augmentation
from graspq.train.batch import Batch, to_tensors
from graspq.train.checkpoint import load_checkpoint, remove_unfinished, save_checkpoint
from graspq.train.estimators import Estimator, estimator_named
from graspq.train.hardware import Precision, chosen_device, chosen_precision, prepare
from graspq.train.networks import NetworkSpecification, QNetwork
from graspq.train.progress import Progress
from graspq.train.run import Run
from graspq.train.settings import TrainSettings
from graspq.train.state import Context, TrainState, advance, learning_rate, new_state, seeded
from graspq.train.updates import LINKS
from graspq.train.validation import Validation, validate

ACTIONS = 4


class DivergedError(UserError):
    """Training met a number that is not finite."""


def train(settings: TrainSettings, *, stop_at: int | None = None, show_progress: bool = False) -> Run:
    """Train to the last step, from the newest checkpoint of the run folder where there is one.

    Args:
        settings: everything about the run.
        stop_at: stop, with a checkpoint, after this step as if interrupted; None runs to the end.
        show_progress: show a progress bar on standard error.

    Raises:
        UserError: data, run folder or a setting are not usable; see the message.
        DivergedError: a loss or weight was not finite; the newest checkpoint is from before.
        KeyboardInterrupt: SIGINT or SIGTERM came; a checkpoint of the last step was written first.
    """
    prepare(settings)
    estimator = estimator_named(settings.algo)
    pool = open_shards(settings.shards)
    training, held_back = pool.split(settings.validation_fraction, settings.seed)
    discount = estimator.chosen_discount(settings.discount, pool.discount)
    specification = NetworkSpecification(
        settings.network, pool.image_shape, ACTIONS, pool.max_steps, LINKS[settings.loss]
    )
    state = new_state(specification, settings, chosen_device(settings.device))
    config = _configuration(settings, specification, pool, training, held_back, discount)
    run = Run.create_or_resume(settings.run_folder, config)
    with run.locked():
        precision = _precision(run, settings, state.network, pool.image_shape)
        remove_unfinished(run.checkpoints_folder)
        newest = run.latest_checkpoint()
        if newest is not None:
            load_checkpoint(newest, state, specification)
        run.forget_after(state.step)
        session = _Session(settings, estimator, specification, run, state, precision, discount, held_back)
        last = settings.steps if stop_at is None else min(stop_at, settings.steps)
        session.steps(training, last, show_progress)
    return run


def _configuration(
    settings: TrainSettings,
    specification: NetworkSpecification,
    pool: ShardPool,
    training: ShardPool,
    held_back: ShardPool,
    discount: float,
) -> dict[str, Any]:
    """Return the content of a new run's `config.json`."""
    return {
        "command": "grasp-train",
        "settings": settings.to_json(),
        "discount": discount,
        "network": specification.to_json(),
        "dataset": {
            "manifest_sha256": pool.manifest_digest,
            "task": pool.task,
            "action_limits": list(pool.action_limits),
            "discount": pool.discount,
            "object_set": pool.object_set,
            "episodes": pool.episodes,
            "training": {"blocks": len(training.blocks), "episodes": training.episodes, "rows": training.rows},
            "held_back": {"blocks": len(held_back.blocks), "episodes": held_back.episodes, "rows": held_back.rows},
        },
        "versions": versions("torch", "numpy", "pyarrow", "safetensors"),
        "code_revision": code_revision(),
    }


def _precision(run: Run, settings: TrainSettings, network: QNetwork, image_shape: tuple[int, int, int]) -> Precision:
    """Return the precision that the run was begun with on such a device, or choose one and note it in the run."""
    device = next(network.parameters()).device
    known = run.config.get("precision", {})
    if settings.precision == "auto" and known.get("device") == device.type:
        return Precision(known["name"], device, known["probe"])
    chosen = chosen_precision(settings.precision, network, image_shape)
    run.note("precision", {"name": chosen.name, "device": device.type, "probe": chosen.probe})
    return chosen


@dataclasses.dataclass
class _Session:
    """One process's part of a run."""

    settings: TrainSettings
    estimator: Estimator
    specification: NetworkSpecification
    run: Run
    state: TrainState
    precision: Precision
    discount: float
    held_back: ShardPool
    saved_step: int | None = None

    def steps(self, pool: ShardPool, last: int, show_progress: bool) -> None:
        """Train until step `last`."""
        settings, state = self.settings, self.state
        if state.step >= last:
            return
        augmentation = Augmentation(settings.shift, settings.mirror, settings.jitter, settings.action_noise)
        loader = self._loader(pool)
        progress = Progress(self.run, settings, state.step, show_progress)
        with loader, progress, _Interruption() as interruption:
            while state.step < last and not interruption.requested:
                with progress.timed():
                    batch = to_tensors(cast(TransitionBatch | EpisodeBatch, next(loader)), self.precision.device)
                    batch = augmentation(batch, seeded("train/augment", settings.seed, state.step))
                    loss = self._update(batch)
                progress.count(state.step, loss)
                self._after_step(progress)
            if self.saved_step != state.step:
                self._log(progress)
                self._save()
        if interruption.requested:
            raise KeyboardInterrupt

    def _loader(self, pool: ShardPool) -> TransitionLoader | EpisodeLoader:
        settings, start = self.settings, self.state.step
        if self.estimator.view == "episodes":
            return EpisodeLoader(pool, settings.batch_size, settings.seed, settings.buffer_bytes, start)
        return TransitionLoader(
            pool,
            settings.batch_size,
            settings.seed,
            settings.buffer_bytes,
            start,
            need_next=self.estimator.needs_next,
        )

    def _update(self, batch: Batch) -> Tensor:
        """Take one step; return its loss."""
        rate = learning_rate(self.settings, self.state.step)
        for optimizer, _ in self.state.optimizers.values():
            for group in optimizer.param_groups:
                group["lr"] = rate
        context = self._context(self.state.network, seeded("train/candidates", self.settings.seed, self.state.step))
        loss = self.estimator.update(self.state, batch, self.estimator, context)
        advance(self.state, self.settings)
        return loss

    def _context(self, network: QNetwork, generator: torch.Generator) -> Context:
        return Context(
            network=network,
            lagged=self.state.lagged,
            loss=self.settings.loss,
            discount=self.discount,
            candidates=self.settings.candidates,
            generator=generator,
            progress=self.state.step / self.settings.steps,
            autocast=self.precision.autocast,
        )

    def _after_step(self, progress: Progress) -> None:
        """Log, validate and save where it is time to."""
        settings, step = self.settings, self.state.step
        finished = step >= settings.steps
        saves = finished or step % settings.checkpoint_every == 0
        if saves or step % settings.log_every == 0:
            self._log(progress)
        if finished or step % settings.validate_every == 0:
            self._check_weights()
            result = self.validate()
            if result is not None:
                progress.log_validation(step, result)
        if saves:
            self._save()

    def _log(self, progress: Progress) -> None:
        bad = progress.log(self.state.step, learning_rate(self.settings, self.state.step - 1))
        if bad is not None:
            self._diverged(bad, "loss")

    def validate(self) -> Validation | None:
        """Judge the policy's network on held-back transitions; the same ones and the same candidates each time."""
        context = self._context(self.state.policy_network, seeded("train/validation", self.settings.seed))
        return validate(self._held_back_batches(), self.estimator, context)

    def _held_back_batches(self) -> Iterator[Batch]:
        rows = itertools.accumulate(ref.rows for ref in self.held_back.blocks)
        kept = sum(1 for total in rows if total <= self.settings.validation_transitions)
        pool = dataclasses.replace(self.held_back, blocks=self.held_back.blocks[: max(kept, 1)])
        size = self.settings.batch_size
        if self.estimator.view == "episodes":
            yield from (to_tensors(batch, self.precision.device) for batch in episode_batches(pool, size))
        else:
            batches = transition_batches(pool, size, self.estimator.needs_next)
            yield from (to_tensors(batch, self.precision.device) for batch in batches)

    def _check_weights(self) -> None:
        for name, network in self.state.networks.items():
            for part, tensor in network.state_dict().items():
                if not bool(torch.isfinite(tensor).all()):
                    self._diverged(self.state.step, f"{part} of the {name} network")

    def _save(self) -> None:
        self._check_weights()
        save_checkpoint(self.run.checkpoints_folder, self.state, self.specification)
        self.run.prune(self.settings.keep_checkpoints)
        self.saved_step = self.state.step

    def _diverged(self, step: int, quantity: str) -> None:
        newest = self.run.latest_checkpoint()
        kept = f"{newest} is the last good checkpoint" if newest is not None else "no checkpoint was written yet"
        raise DivergedError(
            f"{self.settings.algo} diverged at step {step}: the {quantity} is not finite; {kept}; "
            "try a lower --learning-rate with another --out"
        )


class _Interruption:
    """Notes SIGINT and SIGTERM so that the step that runs ends first; a second one interrupts at once."""

    def __init__(self) -> None:
        self.requested = False
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> "_Interruption":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._note)
        return self

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
