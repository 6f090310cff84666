"""`ddpg`: deep deterministic policy gradient. An actor network learns to give the action that Q rates best.

Dimensions: n states of a batch, B batch, T steps, A action. Measurements: docs/estimators/ddpg.md.
"""

import dataclasses

import torch
from torch import Tensor

from graspq.common.options import setting
from graspq.train.acting import ActorNetwork
from graspq.train.batch import Batch
from graspq.train.estimator import Estimator, LaggedSettings, Metrics, RegressionSettings, TargetValue, regression
from graspq.train.networks import q_network, state_network
from graspq.train.selection import FARTHEST_POINT, QOfActions, pointed
from graspq.train.state import Networks, TrainState
from graspq.train.targets import bootstrapped

STEEPEST = 1.0


@dataclasses.dataclass(frozen=True)
class DdpgSettings(LaggedSettings, RegressionSettings):
    """Options of `ddpg`."""

    actor_rest: float = setting(
        0.2, help="Part of the steps in which the actor stays as it began, while Q learns.", minimum=0, maximum=1
    )
    actor_rate: float = setting(0.3, help="Learning rate of the actor over that of Q.", minimum=0, maximum=10)
    actor_every: int = setting(2, help="Steps of Q from one step of the actor to the next.", minimum=1)


def target(
    batch: Batch, networks: Networks, settings: DdpgSettings, random: torch.Generator, progress: float
) -> Tensor:
    """Return r + γ Q_θ'(s', π_φ'(s')), both networks lagged copies; float [B, T]. See `targets.bootstrapped`.

    Source: Quillen et al. 2018, section "Deep Deterministic Policy Gradient".
    Differs: 1. The released code has no lagged actor; the paper's text has one. 2. It leaves the discount at 1 (with
    `--preset paper`); here it is the text's 0.9.
    """
    image, step = batch.next_states
    action = pointed(networks.lagged["actor"](image, step), networks.specification.action).clamp(-1, 1)
    next_value = networks.lagged_q.at(image, step)(action.unsqueeze(1))
    return bootstrapped(batch.reward, batch.terminal, batch.before(next_value), settings.discount)


def actor_critic(
    estimator: Estimator[DdpgSettings],
    state: TrainState,
    batch: Batch,
    settings: DdpgSettings,
    random: torch.Generator,
    progress: float,
) -> Metrics:
    """Take one step of regression with Q_θ, then one step of the actor up Q_θ; return the critic's metrics.

        φ ← φ + optimiser(mean g(s) · ∂π_φ(s) / ∂φ),  g = `uphill` of Q_θ at π_φ(s)

    The critic judges in evaluation mode, and its weights stay as they are.

    Source: Quillen et al. 2018, section "Deep Deterministic Policy Gradient".
    Differs: 3. An action lies in the box [-1, 1]ᴬ that the data fill, see `selection.pointed`; the released actor is
    unbounded. 4. The actor starts where a search starts. With `--preset paper` all is undone of: 5. it rests at the
    start (`--actor-rest`); 6. its rate is 0.3 of Q's (`--actor-rate`; Lillicrap et al. 2015: a tenth); 7. it takes a
    step after every second of Q (`--actor-every`), as in Fujimoto et al. 2018.
    """
    metrics = regression(estimator, state, batch, settings, random, progress)
    if progress < settings.actor_rest or state.step % settings.actor_every != 0:
        return metrics
    networks = state.networks
    actor = networks.online["actor"].train()
    image, step = batch.real(batch.image), batch.real(batch.step)
    networks.q.eval()
    with torch.no_grad(), networks.autocast():
        q_of_actions = networks.q.at(image, step)
    with networks.autocast():
        direction = pointed(actor(image, step), networks.specification.action)
        gradient = uphill(q_of_actions, direction.detach())
    state.slow_down("actor", settings.actor_rate)
    state.descend("actor", -(gradient * direction).sum(-1).mean())
    return metrics


def uphill(q_of_actions: QOfActions, direction: Tensor) -> Tensor:
    """Return which way Q rises at the actions that an actor points at.

        g = clip(∂Q(s, a) / ∂a, -1, 1) at a = clip(direction, -1, 1),
        times -(|directionᵢ| - 1) / 0.25 where directionᵢ is at or beyond a bound and gᵢ points further out: back again

    Args:
        q_of_actions: Q-function of candidates, in evaluation mode.
        direction: what `pointed` gave, float32 [n, A], without gradient.

    Returns:
        float32 [n, A].

    Source: released code, `ddpg_graph`: dQ/da clipped to ±1. Differs: 8. It has no bounds to stop at.
    """
    with torch.enable_grad():
        action = direction.clamp(-1, 1).requires_grad_()
        q = q_of_actions(action.unsqueeze(1)).squeeze(1)
        (gradient,) = torch.autograd.grad(q.float().sum(), action)
    gradient = gradient.clamp(-STEEPEST, STEEPEST)
    outward = (direction.abs() >= 1) & (gradient * direction > 0)
    back = -gradient * (direction.abs() - 1) / (FARTHEST_POINT - 1)
    return torch.where(outward, back, gradient)


row = Estimator(
    summary="Deep deterministic policy gradient: a network learns to give the action that Q rates best",
    settings=DdpgSettings,
    target_value=TargetValue("bootstrapped", target, needs_next=True, needs_return=False),
    action_selection=ActorNetwork(),
    paper=DdpgSettings(loss="huber", discount=1.0, actor_rest=0.0, actor_rate=1.0, actor_every=1),
    parts={"q": q_network, "actor": state_network(lambda specification: specification.actions)},
    update=actor_critic,
)
