"""The training loop: batches in the sampler's order, one update each, validation, metrics and checkpoints.

Every step is a function of the settings, the step and the state before it, so that a run that was stopped at any moment
and started again ends in the same weights: bit for bit on a CPU with the same number of threads, and as far as the
driver's kernels are deterministic on a GPU.
"""

from graspq.datasets.dataset import open_shards
from graspq.datasets.pool import ShardPool
from graspq.train.augment import augmented
from graspq.train.batch import Batch
from graspq.train.batches import training_batches
from graspq.train.estimator import Metrics
from graspq.train.interruption import Interruption
from graspq.train.parallel import ALONE, Ranks
from graspq.train.run import Run
from graspq.train.run_log import LOG_EVERY, RunLog
from graspq.train.session import Session, session
from graspq.train.settings import TrainSettings
from graspq.train.state import advance, learning_rate, seeded


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
    settings = settings.for_grasps(pool.episodes)
    with session(settings, pool, training, held_back, ranks=ranks) as current:
        last = settings.last_step if stop_at is None else min(stop_at, settings.last_step)
        train_until(last, current, training, show_progress)
    return current.run


def train_until(last: int, current: Session, pool: ShardPool, show_progress: bool = False) -> None:
    """Train on a pool until step `last`, and leave a checkpoint of it; raises as `train` does."""
    settings, state, ranks = current.settings, current.state, current.ranks
    if state.step >= last:
        return
    source = training_batches(pool, settings, state.networks.precision.device, state.step, ranks)
    log = RunLog(current.run, settings, state.step, show_progress, ranks.first)
    with source as batches, log, Interruption() as interruption:
        while state.step < last and not ranks.any(interruption.requested):
            with log.timed():
                metrics = update(current, next(batches))
            log.count(metrics)
            saves = state.step >= settings.last_step or state.step % settings.save_every == 0
            if saves or state.step % LOG_EVERY == 0:
                current.write(log)
            if saves:
                current.save_and_validate(log)
        if current.saved_step != state.step:
            current.write(log)
            current.save()
        # Together: `torchrun` ends the others as soon as one has gone.
        interrupted = ranks.any(interruption.requested)
    if interrupted:
        raise KeyboardInterrupt


def update(current: Session, batch: Batch) -> Metrics:
    """Take one step on a batch as the loader gives it; return what its update measured."""
    settings, state, estimator = current.settings, current.state, current.estimator
    # Ranks have numbers of their own; those of one process do not depend on how many there could be.
    keys = (settings.seed, state.step, *([current.ranks.rank] if current.ranks.count > 1 else []))
    mirror = state.networks.specification.action.mirror if settings.mirror else None
    batch = augmented(batch, settings.shift, mirror, seeded("train/augment", *keys), settings.color)
    rate = learning_rate(settings, state.step)
    for part in state.optimizers:
        state.set_rate(part, rate)
    random, done = seeded("train/candidates", *keys), state.step / settings.last_step
    # `estimator.regression`, unless the row has an update of its own.
    metrics = estimator.update(estimator, state, batch, settings.own, random, done)
    advance(state, settings.average_decay, settings.own.lag)
    return metrics
