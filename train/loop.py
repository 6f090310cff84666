"""The training loop: batches in the sampler's order, one update each, validation, metrics and checkpoints.

Every step is a function of the settings, the step and the state before it, so that a run that was stopped at any moment
and started again ends in the same weights: bit for bit on a CPU with the same number of threads, and as far as the
driver's kernels are deterministic on a GPU.
"""

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import torch
from torch import Tensor

from graspq.common.errors import UserError
from graspq.common.provenance import code_revision, versions
from graspq.datasets.dataset import open_shards
from graspq.datasets.pool import ShardPool
from graspq.train.augment import Augmentation
from graspq.train.batch import Batch
from graspq.train.batches import batch_rows, held_back_batches, training_batches
from graspq.train.checkpoint import load_checkpoint, save_checkpoint
from graspq.train.distributed import ALONE, WHOLE, BatchPart, Ranks, unite
from graspq.train.estimators import Estimator, estimator_named
from graspq.train.hardware import Precision, chosen_device, compile_networks, prepare
from graspq.train.interruption import Interruption
from graspq.train.networks import NetworkSpecification
from graspq.train.opening import is_compiled, opened, precision_of
from graspq.train.progress import Progress
from graspq.train.run import Run
from graspq.train.settings import TrainSettings
from graspq.train.state import Context, Networks, TrainState, advance, learning_rate, new_state, seeded
from graspq.train.updates import LINKS
from graspq.train.validation import Validation, validate

ACTIONS = 4


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
        ranks: those that train together, each calling this; see `distributed.joined`.

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
    described: dict[str, Any] | None = None,
    ranks: Ranks = ALONE,
) -> Iterator["Session"]:
    """Open a run's folder for these ranks alone: a new one, or the one that is there, at its newest checkpoint.

    Args:
        settings: everything about the run.
        pool: all data, as `config.json` describes them.
        training: part of the pool to train on.
        held_back: part of the pool to validate on.
        start: checkpoint of another run that a new run goes on from; its own weights at step 0 where not given.
        described: further entries of `config.json`.
        ranks: those that train together.

    Raises:
        UserError: data, run folder or a setting are not usable; see the message.
    """
    prepare(settings)
    estimator = estimator_named(settings.algo)
    discount = estimator.chosen_discount(settings.discount, pool.discount)
    specification = NetworkSpecification(
        settings.network, pool.image_shape, ACTIONS, pool.max_steps, LINKS[settings.loss], settings.width
    )
    device = chosen_device(settings.device)
    state = new_state(specification, settings, device, estimator.parts)
    if ranks.first and discount != pool.discount and (estimator.discount is None or not estimator.takes_discount):
        stored = f"the data's are of discount {pool.discount:g}"
        click.echo(f"{settings.algo}: returns are made from the rewards with discount {discount:g}; {stored}", err=True)
    config = _configuration(settings, specification, pool, training, held_back, discount) | (described or {})
    with opened(settings.run_folder, config, ranks) as run:
        precision = ranks.from_first(lambda: precision_of(run, settings, specification, device))
        compiled = ranks.from_first(lambda: is_compiled(run, settings, specification, precision))
        newest = ranks.from_first(run.latest_checkpoint)
        loaded = newest if newest is not None else start
        if loaded is not None:
            load_checkpoint(loaded, state, specification)
        else:
            # A new run alone: what reads all the data is not done again at every start.
            state.extra = {name: tensor.to(device) for name, tensor in estimator.extra(training).items()}
        run.forget_after(state.step)
        ranks.spread(state.tensors)
        unite(state.learned.values(), state.optimizers.values(), ranks)
        if compiled:
            compile_networks(state.networks.values())
        saved = state.step if newest is not None else None
        yield Session(settings, estimator, specification, run, state, precision, discount, held_back, ranks, saved)


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
        "mc_return": "as stored" if discount == pool.discount else f"made from the rewards with discount {discount:g}",
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


@dataclasses.dataclass
class Session:
    """One process's part of a run; see `session`."""

    settings: TrainSettings
    estimator: Estimator
    specification: NetworkSpecification
    run: Run
    state: TrainState
    precision: Precision
    discount: float
    held_back: ShardPool
    ranks: Ranks = ALONE
    saved_step: int | None = None
    watched: dict[str, Tensor] = dataclasses.field(default_factory=dict)

    def steps(self, pool: ShardPool, last: int, show_progress: bool) -> None:
        """Train on `pool` until step `last`, and leave a checkpoint of it."""
        settings, state = self.settings, self.state
        if state.step >= last:
            return
        pool = pool.with_discount(self.discount)
        rows = batch_rows(pool, settings, self.estimator)
        device, ranks = self.precision.device, self.ranks
        source = training_batches(pool, settings, self.estimator, device, state.step, ranks)
        progress = Progress(self.run, settings, state.step, show_progress)
        with source as batches, progress, Interruption() as interruption:
            while state.step < last and not ranks.any(interruption.requested):
                with progress.timed():
                    batch = next(batches)
                    loss = self.update(batch, BatchPart.of(ranks, rows, batch.real_steps))
                progress.count(loss, self.watched)
                self._after_step(progress)
            if self.saved_step != state.step:
                self._log(progress)
                self.save()
            # Together: `torchrun` ends the others as soon as one has gone.
            interrupted = ranks.any(interruption.requested)
        if interrupted:
            raise KeyboardInterrupt

    def update(self, batch: Batch, part: BatchPart = WHOLE) -> Tensor:
        """Take one step on a batch as the loader gives it; return its loss.

        Args:
            batch: this rank's.
            part: which part of the whole batch that is.
        """
        settings = self.settings
        augmentation = Augmentation(settings.shift, settings.mirror, settings.jitter, settings.action_noise)
        batch = augmentation(batch, seeded("train/augment", settings.seed, self.state.step), part)
        rate = learning_rate(settings, self.state.step)
        for optimizer in self.state.optimizers.values():
            for group in optimizer.param_groups:
                group["lr"] = rate
        generator = seeded("train/candidates", settings.seed, self.state.step)
        context = self._context(self.state.learned, generator, part)
        loss = self.estimator.update(self.state, batch, self.estimator, context)
        advance(self.state, settings)
        for name, value in self.watched.items():
            self.watched[name] = part.mean(value)
        return part.mean(loss)

    def _context(self, networks: Networks, generator: torch.Generator, part: BatchPart = WHOLE) -> Context:
        return Context(
            networks=networks,
            lagged_networks=self.state.lagged,
            loss=self.settings.loss,
            discount=self.discount,
            candidates=self.settings.candidates,
            generator=generator,
            progress=self.state.step / self.settings.steps,
            autocast=self.precision.autocast,
            extra=self.state.extra,
            anneal=self.settings.anneal,
            centred=self.settings.centred,
            mirror=self.settings.mirror,
            actor_rest=self.settings.actor_rest,
            actor_rate=self.settings.actor_rate,
            actor_every=self.settings.actor_every,
            path_steps=self.settings.path_steps,
            penalty=self.settings.penalty,
            kl_bound=self.settings.kl_bound,
            watched=self.watched,
            part=part,
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
            result = self.validate() if self.ranks.first else None
            if result is not None:
                progress.log_validation(step, result)
        if saves:
            self.save()

    def _log(self, progress: Progress) -> None:
        bad = progress.log(self.state.step, learning_rate(self.settings, self.state.step - 1))
        if bad is not None:
            self._diverged(*bad)

    def validate(self) -> Validation | None:
        """Judge the policy's networks on held-back transitions; the same ones and the same candidates each time."""
        context = self._context(self.state.acting, seeded("train/validation", self.settings.seed))
        held_back = self.held_back.with_discount(self.discount)
        batches = held_back_batches(held_back, self.settings, self.estimator, self.precision.device)
        return validate(batches, self.estimator, context)

    def _check_weights(self) -> None:
        for name, network in self.state.networks.items():
            for part, tensor in network.state_dict().items():
                if not bool(torch.isfinite(tensor).all()):
                    self._diverged(self.state.step, f"{part} of the {name} network is not finite")

    def save(self) -> None:
        """Write a checkpoint of the step, unless there is one."""
        if self.saved_step == self.state.step:
            return
        self._check_weights()
        if self.ranks.first:
            save_checkpoint(self.run.checkpoints_folder, self.state, self.specification)
        self.run.prune(self.settings.keep_checkpoints)
        self.saved_step = self.state.step

    def _diverged(self, step: int, found: str) -> None:
        # What an update found was so with the weights that the one before it had left.
        self.run.forget_checkpoints_from(step - 1)
        newest = self.run.latest_checkpoint()
        kept = f"{newest} is the last good checkpoint" if newest is not None else "no good checkpoint was written yet"
        raise DivergedError(
            f"{self.settings.algo} diverged at step {step}: the {found}; {kept}; "
            "try a lower --learning-rate with another --out"
        )
