"""Deep deterministic policy gradient: an actor network learns to give the action that Q rates best.

Dimensions: n states of a batch, B batch, T steps, A action.

Differs, for `ddpg` (what all rows share stands in `estimators`):
1. The released code has no lagged actor; the paper's text has one, and so has this.
2. The released actor is linear and unbounded and the environment takes what it says; here an action lies in the box
   [-1, 1]⁴ that the data fill, because Q knows nothing outside it. See `selection.pointed`.
3. The actor starts straight down, where the search of the other estimators starts, and not at (0, 0, 0, 0).
4. The released code leaves the discount at 1; here 0.9 as in the paper's text (0.95 by `--discount`).
5. The actor stays as it began for a fifth of the steps (`--actor-rest`; 0 with `--preset paper`). Q is then first
   learned for actions that the data are full of; an actor that follows a Q which has learned nothing yet goes up, where
   few logged actions contradict it. Measured without a rest and with the rate of Q: at the end of a run of 150 steps
   its mean dz was +0.9, and all of 50 episodes lasted until T, without a grasp.
6. Its learning rate is then a tenth of Q's (`--actor-rate`), as in Lillicrap et al. 2015; the released code has one
   rate for both, and so has `--preset paper`. Adam's steps do not shrink with the slope of Q, which is small (0.005 in
   such short runs): at Q's rate the actor was in a corner of the box within 30 steps, wherever Q sloped.
7. It takes a step after every second step of Q (`--actor-every`; 1 with `--preset paper`), as in Fujimoto et al. 2018:
   a step of both costs 1.8 times one of Q alone.
8. It is otherwise trained with Q's settings, and acts by the average of its weights where Q does (`--average-decay`).
"""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from graspq.train.batch import Batch
from graspq.train.selection import FARTHEST_POINT, QOfActions, pointed
from graspq.train.targets import bootstrapped
from graspq.train.updates import descend, regression, slow_down

if TYPE_CHECKING:
    from graspq.train.estimators import Estimator
    from graspq.train.state import Context, TrainState

STEEPEST = 1.0


def lagged_actor_target(batch: Batch, context: "Context") -> Tensor:
    """Return r + γ Q_θ'(s', π_φ'(s')), both networks lagged copies; float [B, T]. See `targets.bootstrapped`.

    Source: Quillen et al. 2018, section "Deep Deterministic Policy Gradient".
    """
    image, step = batch.next_states
    action = pointed(context.lagged_networks["actor"](image, step)).clamp(-1, 1)
    next_value = context.lagged.at(image, step)(action.unsqueeze(1)).squeeze(1)
    return bootstrapped(batch.reward, batch.terminal, next_value.view_as(batch.reward), context.discount)


def actor_critic(state: "TrainState", batch: Batch, estimator: "Estimator", context: "Context") -> Tensor:
    """Take one step of regression with Q_θ, then one step of the actor up Q_θ; return the critic's loss.

        φ ← φ + optimiser(mean g(s) · ∂π_φ(s) / ∂φ),  g = `uphill` of Q_θ at π_φ(s)

    The critic judges in evaluation mode, and its weights stay as they are. See 5. and 7. of the module for when there
    is no step of the actor.

    Source: Quillen et al. 2018, section "Deep Deterministic Policy Gradient"; its actor takes a step at each.
    """
    loss = regression(state, batch, estimator, context)
    if context.progress < context.actor_rest or state.step % context.actor_every != 0:
        return loss
    actor = state.learned["actor"].train()
    image, step = batch.real(batch.image), batch.real(batch.step)
    state.learned["q"].eval()
    with torch.no_grad(), context.autocast():
        q_of_actions = context.network.at(image, step)
    with context.autocast():
        direction = pointed(actor(image, step))
        gradient = uphill(q_of_actions, direction.detach())
    slow_down(state.optimizers["actor"], context.actor_rate)
    descend(state.optimizers["actor"], -(gradient * direction).sum(-1).mean(), context.part)
    return loss


def uphill(q_of_actions: QOfActions, direction: Tensor) -> Tensor:
    """Return which way Q rises at the actions that an actor points at.

        g = clip(∂Q(s, a) / ∂a, -1, 1) at a = clip(direction, -1, 1),
        times -(|directionᵢ| - 1) / 0.25 where directionᵢ is at or beyond a bound and gᵢ points further out: back again

    Args:
        q_of_actions: Q-function of candidates, in evaluation mode.
        direction: what `pointed` gave, float32 [n, A], without gradient.

    Returns:
        float32 [n, A].

    Source: released code, `ddpg_graph`: dQ/da clipped to ±1. Differs: it has no bounds to stop at.
    """
    with torch.enable_grad():
        action = direction.clamp(-1, 1).requires_grad_()
        q = q_of_actions(action.unsqueeze(1)).squeeze(1)
        (gradient,) = torch.autograd.grad(q.float().sum(), action)
    gradient = gradient.clamp(-STEEPEST, STEEPEST)
    outward = (direction.abs() >= 1) & (gradient * direction > 0)
    back = -gradient * (direction.abs() - 1) / (FARTHEST_POINT - 1)
    return torch.where(outward, back, gradient)
