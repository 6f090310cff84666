"""A run whose folder is open: what it began with, its state, and what is done with that between steps of training."""

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
from graspq.datasets.pool import ShardPool
from graspq.train.batches import held_back_batches
from graspq.train.checkpoint import load_checkpoint, newest_whole, save_checkpoint
from graspq.train.device import chosen_device, chosen_precision, prepare
from graspq.train.estimator import Estimator
from graspq.train.networks.network import NetworkSpecification
from graspq.train.parallel import ALONE, Ranks
from graspq.train.run import Run
from graspq.train.run_log import RunLog
from graspq.train.settings import FREE, TrainSettings
from graspq.train.state import TrainState, learning_rate, new_state, seeded
from graspq.train.validation import Validation, validate


class DivergedError(UserError):
    """Training met a number that is not finite, or values far beyond what the task allows."""


@dataclasses.dataclass
class Session:
    """A run whose folder is open; see `session`."""

    settings: TrainSettings
    estimator: Estimator[Any]
    run: Run
    state: TrainState
    held_back: ShardPool
    ranks: Ranks = ALONE
    saved_step: int | None = None

    def write(self, log: RunLog) -> None:
        """Write the metrics of the steps since the last time.

        Raises:
            DivergedError: one of them is not finite, or far beyond [0, 1].
        """
        bad = log.log(self.state.step, learning_rate(self.settings, self.state.step - 1))
        if bad is not None:
            self._diverged(*bad)

    def validate(self) -> Validation | None:
        """Judge the policy's networks on held-back transitions; the same ones and the same candidates each time."""
        settings, state = self.settings, self.state
        batches = held_back_batches(self.held_back, settings, state.networks.precision.device)
        random, done = seeded("train/validation", settings.seed), state.step / settings.last_step
        return validate(batches, self.estimator, state.acting, settings.own, random, done)

    def save_and_validate(self, log: RunLog) -> None:
        """Validate, and write a checkpoint of the step.

        Raises:
            DivergedError: a weight or the held-back loss is not finite.
        """
        self._check_weights()
        result = self.validate() if self.ranks.first else None
        if result is not None:
            if not all(math.isfinite(value) for value in (result.loss, result.loss_last_step or 0.0)):
                self._diverged(self.state.step, "held-back loss is not finite")
            log.log_validation(self.state.step, result)
        self.save()

    def save(self) -> None:
        """Write a checkpoint of the step, unless there is one.

        Raises:
            DivergedError: a weight is not finite.
        """
        if self.saved_step == self.state.step:
            return
        self._check_weights()
        if self.ranks.first:
            self.run.sync_metrics()
            save_checkpoint(self.run.checkpoints_folder, self.state)
            self.run.prune(self.state.step)
        self.saved_step = self.state.step

    def _check_weights(self) -> None:
        for name, network in self.state.named_networks.items():
            for part, tensor in network.state_dict().items():
                if not bool(torch.isfinite(tensor).all()):
                    self._diverged(self.state.step, f"{part} of the {name} network is not finite")

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
) -> Iterator[Session]:
    """Open a run's folder for this process alone: a new one, or the one that is there, at its newest whole checkpoint.

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
    estimator, device = settings.estimator, chosen_device(settings.device)
    precision = chosen_precision(settings.precision, device)
    specification = NetworkSpecification(
        name=settings.network,
        image_shape=pool.image_shape,
        action=pool.action,
        steps=pool.max_steps,
        link=estimator.loss(settings.own).link,
        settings=settings.network_own.to_json(),
    )
    lagged = settings.own.lag is not None
    state = new_state(
        specification, estimator.parts_of(settings.own), settings, settings.seed, precision, lagged=lagged, ranks=ranks
    )
    config = _configuration(settings, pool, training, held_back, specification, precision.name) | {**(described or {})}
    with contextlib.ExitStack() as stack:

        def opened() -> tuple[Run, Path | None]:
            run = stack.enter_context(Run.held(settings.run_folder, config, FREE))
            return run, newest_whole(run)

        if ranks.first and config["mc_return"].startswith("made"):
            told = f"the data's are of discount {pool.discount:g}"
            click.echo(f"{settings.algo}: returns are {config['mc_return']}; {told}", err=True)
        run, newest = ranks.from_first(opened)
        checkpoint = newest if newest is not None else start
        if checkpoint is not None:
            load_checkpoint(checkpoint, state)
        else:
            # A new run alone: what reads all the data is not done again at every start.
            kept = estimator.kept(training, settings.own)
            state.networks.kept.update({name: tensor.to(device) for name, tensor in kept.items()})
        if ranks.first:
            run.forget_after(state.step)
            run.prune(state.step)  # what a cut between a checkpoint and the removal of an older one has left
        yield Session(settings, estimator, run, state, held_back, ranks, state.step if newest is not None else None)


def _configuration(
    settings: TrainSettings,
    pool: ShardPool,
    training: ShardPool,
    held_back: ShardPool,
    specification: NetworkSpecification,
    precision: str,
) -> dict[str, Any]:
    """Return what `config.json` says of a run of `grasp-train`."""
    discount = settings.own.chosen_discount(pool.discount)
    remade = settings.estimator.target_value.needs_return and discount != pool.discount
    parts = {"training": training, "held_back": held_back}
    return {
        "command": "grasp-train",
        "settings": settings.to_json(),
        "precision": precision,
        "discount": discount,
        "mc_return": f"made from the rewards with discount {discount:g}" if remade else "as stored",
        "network": specification.to_json(),
        "dataset": {
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
        },
        "versions": versions("torch", "numpy", "pyarrow", "safetensors"),
        "code_revision": code_revision(),
    }
