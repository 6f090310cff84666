"""Losses, and the update that most estimators share: one step of plain regression onto the target values.

An estimator that needs another update brings its own function of the same signature. Dimensions: n states of a batch.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor
from torch.nn import functional

from graspq.train.batch import Batch
from graspq.train.distributed import BatchPart
from graspq.train.networks import Link

if TYPE_CHECKING:
    from graspq.train.estimators import Estimator
    from graspq.train.state import Context, TrainState

LossName = Literal["cross-entropy", "squared"]


def cross_entropy(output: Tensor, target: Tensor) -> Tensor:
    """Return -y log Q - (1 - y) log(1 - Q) with Q = 1 / (1 + exp(-output)), for targets y in [0, 1]; float [n].

    Its minimum over Q is the mean of y, as that of the squared error is.
    Differs: the paper regresses with `squared`. Returns are probabilities of success here, for which this is the
    likelihood; it does not lose its gradient where Q is sure and wrong.
    """
    return functional.binary_cross_entropy_with_logits(output, target, reduction="none")


def squared(output: Tensor, target: Tensor) -> Tensor:
    """Return ½ (Q - y)² with Q = output; float [n].

    Source: Quillen et al. 2018, section "Off-Policy Q-Learning". The released code's Huber loss with δ = 1 is the same
    where |Q - y| ≤ 1.
    """
    return 0.5 * (output - target) ** 2


LOSSES: dict[LossName, Callable[[Tensor, Tensor], Tensor]] = {"cross-entropy": cross_entropy, "squared": squared}
LINKS: dict[LossName, Link] = {"cross-entropy": "logistic", "squared": "identity"}

Update = Callable[["TrainState", Batch, "Estimator", "Context"], Tensor]
"""Changes the state by one step on a batch and returns the loss, a float32 scalar without gradient."""
Objective = Callable[[Batch, "Estimator", "Context"], Tensor]
"""Returns the mean loss of the context's networks on a batch, a float32 scalar, without changing anything."""


def regression(state: "TrainState", batch: Batch, estimator: "Estimator", context: "Context") -> Tensor:
    """Take one gradient step on the mean loss between Q_θ(s, a) and the estimator's target.

    θ ← θ - optimiser(∇_θ mean ℓ(Q_θ(s_t, a_t), y_t)),  y_t fixed
    """
    q = state.learned["q"]
    q.eval()
    target = target_of(batch, estimator, context)
    q.train()
    loss = loss_of(batch, target, estimator, context)
    descend(state.optimizers["q"], loss, context.part)
    return loss.detach()


def regression_objective(batch: Batch, estimator: "Estimator", context: "Context") -> Tensor:
    """Return the mean loss between Q_θ(s, a) and the estimator's target."""
    return loss_of(batch, target_of(batch, estimator, context), estimator, context)


def descend(optimizer: torch.optim.Optimizer, loss: Tensor, part: BatchPart) -> None:
    """Take the optimiser's step down the gradient of the mean loss of a part of a batch: of all parts, with ranks."""
    optimizer.zero_grad(set_to_none=True)
    (loss * part.share).backward()  # type: ignore[no-untyped-call]
    optimizer.step()


def slow_down(optimizer: torch.optim.Optimizer, factor: float) -> None:
    """Multiply the learning rate of the optimiser's next step, which the loop sets anew before every update."""
    for group in optimizer.param_groups:
        group["lr"] *= factor


def target_of(batch: Batch, estimator: "Estimator", context: "Context") -> Tensor:
    """Return the estimator's target of every real step, float32 [n], without gradient."""
    with torch.no_grad(), context.autocast():
        target = batch.real(estimator.target(batch, context)).float()
    context.watched["target"] = target.abs().mean()
    return target


def loss_of(batch: Batch, target: Tensor, estimator: "Estimator", context: "Context") -> Tensor:
    """Return the mean loss of the context's network, as it stands, against targets [n]; float32 scalar."""
    with context.autocast():
        output = context.network(batch.real(batch.image), batch.real(batch.step), batch.real(estimator.action(batch)))
    output = output.float()
    context.watched["Q"] = context.network.value_of(output.detach()).abs().mean()
    return LOSSES[context.loss](output, target).mean()
