"""The training loop: batches in the sampler's order, one update each, validation, metrics and checkpoints.

Every step is a function of the settings, the step and the state before it, so that a run that was stopped at any moment
and started again ends in the same weights: bit for bit on a CPU with the same number of threads, and as far as the
driver's kernels are deterministic on a GPU.
"""

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import click
import torch

from graspq.common.errors import UserError
from graspq.common.provenance import code_revision, versions
from graspq.datasets.dataset import open_shards
from graspq.datasets.pool import ShardPool
from graspq.train.augment import augmented
from graspq.train.batch import Batch
from graspq.train.batches import held_back_batches, training_batches
from graspq.train.checkpoint import load_checkpoint, save_checkpoint
from graspq.train.device import chosen_device, chosen_precision, prepare
from graspq.train.estimator import Metrics
from graspq.train.interruption import Interruption
from graspq.train.networks.network import NetworkSpecification
from graspq.train.parallel import ALONE, Ranks
from graspq.train.progress import LOG_EVERY, Progress
from graspq.train.run import Run
from graspq.train.settings import FREE, TrainSettings
from graspq.train.state import TrainState, advance, learning_rate, new_state, seeded
from graspq.train.validation import Validation, validate


class DivergedError(UserError):
    """Training met a number that is not finite, or values far beyond what the task allows."""


def train(
    settings: TrainSettings, *, stop_at: int | None = None, show_progress: bool = False, ranks: Ranks = ALONE
) -> Run:
    """Train to the last step, from the newest checkpoint of the run folder where there is one.

    Args:
        settings: everything about the run.
        stop_at: stop, with a checkpoint, after this step as if interrupted; None runs to the end.
        show_progress: show a progress bar on standard error.
        ranks: those that train together, each calling this; see `parallel.joined`.

    Raises:
        UserError: data, run folder or a setting are not usable; see the message.
        DivergedError: a loss or weight was not finite, or values far beyond [0, 1]; the newest checkpoint that is left
            is from before.
        KeyboardInterrupt: SIGINT or SIGTERM came; a checkpoint of the last step was written first.
    """
    pool = open_shards(settings.shards)
    training, held_back = pool.split(settings.validation_fraction, settings.seed)
    with session(settings, pool, training, held_back, ranks=ranks) as current:
        last = settings.steps if stop_at is None else min(stop_at, settings.steps)
        current.steps(training, last, show_progress)
    return current.run


@contextlib.contextmanager
def session(
    settings: TrainSettings,
    pool: ShardPool,
    training: ShardPool,
    held_back: ShardPool,
    *,
    start: Path | None = None,
    described: Mapping[str, Any] | None = None,
    ranks: Ranks = ALONE,
) -> Iterator["Session"]:
    """Open a run's folder for this process alone: a new one, or the one that is there, at its newest checkpoint.

    Args:
        settings: everything about the run.
        pool: all data, as `config.json` describes them.
        training: part of the pool to train on.
        held_back: part of the pool to validate on.
        start: checkpoint of another run that a new run goes on from; its own weights at step 0 where not given.
        described: further entries of `config.json`.
        ranks: those that train together; the first alone writes.

    Raises:
        UserError: data, run folder or a setting are not usable; see the message.
    """
    prepare(settings.threads)
    row, device = settings.row, chosen_device(settings.device)
    precision = chosen_precision(settings.precision, device)
    specification = NetworkSpecification(
        name=settings.network,
        image_shape=pool.image_shape,
        action=pool.action,
        steps=pool.max_steps,
        link=row.loss(settings.own).link,
        settings=settings.network_own.to_json(),
    )
    lagged = hasattr(settings.own, "lag_steps")
    discount = settings.own.chosen_discount(pool.discount)
    if ranks.first and discount != pool.discount and not lagged:
        stored = f"the data's are of discount {pool.discount:g}"
        click.echo(f"{settings.algo}: returns are made from the rewards with discount {discount:g}; {stored}", err=True)
    state = new_state(specification, row.parts, settings, settings.seed, precision, lagged=lagged, ranks=ranks)
    config = {
        "command": "grasp-train",
        "settings": settings.to_json(),
        "precision": precision.name,
        "discount": discount,
        "mc_return": "as stored" if discount == pool.discount else f"made from the rewards with discount {discount:g}",
        "network": specification.to_json(),
        "dataset": _described(pool, training, held_back),
        "versions": versions("torch", "numpy", "pyarrow", "safetensors"),
        "code_revision": code_revision(),
        **(described or {}),
    }
    with contextlib.ExitStack() as stack:

        def opened() -> tuple[Run, Path | None]:
            run = Run.create_or_resume(settings.run_folder, config, FREE)
            stack.enter_context(run.locked())
            return run, run.latest_checkpoint()

        run, newest = ranks.from_first(opened)
        if newest is not None or start is not None:
            load_checkpoint(newest or start, state)  # type: ignore[arg-type]
        else:
            # A new run alone: what reads all the data is not done again at every start.
            kept = row.kept(training, settings.own)
            state.networks.kept.update({name: tensor.to(device) for name, tensor in kept.items()})
        if ranks.first:
            run.forget_after(state.step)
        yield Session(settings, run, state, held_back, ranks, state.step if newest is not None else None)


def _described(pool: ShardPool, training: ShardPool, held_back: ShardPool) -> dict[str, Any]:
    """Return what `config.json` says of the data."""
    parts = {"training": training, "held_back": held_back}
    return {
        "manifest_sha256": pool.manifest_digest,
        "task": pool.task,
        "action": pool.action.to_json(),
        "discount": pool.discount,
        "object_set": pool.object_set,
        "episodes": pool.episodes,
        **{
            name: {"blocks": len(part.blocks), "episodes": part.episodes, "rows": part.rows}
            for name, part in parts.items()
        },
    }


@dataclasses.dataclass
class Session:
    """A run whose folder is open; see `session`."""

    settings: TrainSettings
    run: Run
    state: TrainState
    held_back: ShardPool
    ranks: Ranks = ALONE
    saved_step: int | None = None

    def steps(self, pool: ShardPool, last: int, show_progress: bool) -> None:
        """Train on `pool` until step `last`, and leave a checkpoint of it."""
        settings, state, ranks = self.settings, self.state, self.ranks
        if state.step >= last:
            return
        pool = pool.with_discount(settings.own.chosen_discount(pool.discount))
        device, wanted = state.networks.precision.device, settings.row.target_value
        source = training_batches(pool, settings, wanted, device, state.step, ranks)
        progress = Progress(self.run, settings, state.step, show_progress, ranks.first)
        with source as batches, progress, Interruption() as interruption:
            while state.step < last and not ranks.any(interruption.requested):
                with progress.timed():
                    metrics = self.update(next(batches))
                progress.count(metrics)
                self._after_step(progress)
            if self.saved_step != state.step:
                self._log(progress)
                self.save()
            # Together: `torchrun` ends the others as soon as one has gone.
            interrupted = ranks.any(interruption.requested)
        if interrupted:
            raise KeyboardInterrupt

    def update(self, batch: Batch) -> Metrics:
        """Take one step on a batch as the loader gives it; return what its update measured."""
        settings, state = self.settings, self.state
        # Ranks have numbers of their own; those of one process do not depend on how many there could be.
        keys = (settings.seed, state.step, *([self.ranks.rank] if self.ranks.count > 1 else []))
        mirror = state.networks.specification.action.mirror if settings.mirror else None
        batch = augmented(batch, settings.shift, mirror, seeded("train/augment", *keys))
        rate = learning_rate(settings, state.step)
        for part in state.optimizers:
            state.set_rate(part, rate)
        row, random, progress = settings.row, seeded("train/candidates", *keys), state.step / settings.steps
        metrics = row.update(row, state, batch, settings.own, random, progress)
        advance(state, settings.average_decay, getattr(settings.own, "lag_steps", None))
        return metrics

    def _after_step(self, progress: Progress) -> None:
        """Log, validate and save where it is time to."""
        settings, step = self.settings, self.state.step
        saves = step >= settings.steps or step % settings.save_every == 0
        if saves or step % LOG_EVERY == 0:
            self._log(progress)
        if saves:
            self._check_weights()
            result = self.validate() if self.ranks.first else None
            if result is not None:
                if not all(math.isfinite(value) for value in (result.loss, result.loss_last_step or 0.0)):
                    self._diverged(step, "held-back loss is not finite")
                progress.log_validation(step, result)
            self.save()

    def _log(self, progress: Progress) -> None:
        bad = progress.log(self.state.step, learning_rate(self.settings, self.state.step - 1))
        if bad is not None:
            self._diverged(*bad)

    def validate(self) -> Validation | None:
        """Judge the policy's networks on held-back transitions; the same ones and the same candidates each time."""
        settings, state = self.settings, self.state
        pool = self.held_back.with_discount(settings.own.chosen_discount(self.held_back.discount))
        device = state.networks.precision.device
        batches = held_back_batches(pool, settings, settings.row.target_value, device)
        random, progress = seeded("train/validation", settings.seed), state.step / settings.steps
        return validate(batches, settings.row, state.acting, settings.own, random, progress)

    def _check_weights(self) -> None:
        for name, network in self.state.named_networks.items():
            for part, tensor in network.state_dict().items():
                if not bool(torch.isfinite(tensor).all()):
                    self._diverged(self.state.step, f"{part} of the {name} network is not finite")

    def save(self) -> None:
        """Write a checkpoint of the step, unless there is one."""
        if self.saved_step == self.state.step:
            return
        self._check_weights()
        if self.ranks.first:
            save_checkpoint(self.run.checkpoints_folder, self.state)
            self.run.prune()
        self.saved_step = self.state.step

    def _diverged(self, step: int, found: str) -> None:
        # What an update found was so with the weights that the one before it had left.
        if self.ranks.first:
            self.run.forget_checkpoints_from(step - 1)
        newest = self.run.latest_checkpoint()
        kept = f"{newest} is the last good checkpoint" if newest is not None else "no good checkpoint was written yet"
        raise DivergedError(
            f"{self.settings.algo} diverged at step {step}: the {found}; {kept}; "
            "try a lower --learning-rate with another --out"
        )
