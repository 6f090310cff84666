"""`td3-bc`: an actor network that climbs Q and stays near the logged actions; the smaller of two critics judges it.

Beyond the paper. Derivation: docs/estimators/td3-bc.md. Dimensions: n real states, B batch, T = 1 step, A action.
"""

import dataclasses
from typing import cast

import torch
from torch import Tensor

from graspq.common.options import setting
from graspq.train.acting import ActorNetwork
from graspq.train.batch import Batch
from graspq.train.estimator import (
    Estimator,
    LaggedSettings,
    Metrics,
    RegressionSettings,
    TargetValue,
    loss_of,
    step_towards,
    targets_of,
)
from graspq.train.networks import q_network, state_network
from graspq.train.networks.network import QNetwork
from graspq.train.recipe import DEFAULT
from graspq.train.selection import QOfActions, pointed
from graspq.train.state import Networks, TrainState
from graspq.train.targets import bootstrapped

CRITICS = ("q", "twin")


@dataclasses.dataclass(frozen=True)
class Td3BcSettings(LaggedSettings, RegressionSettings):
    """Options of `td3-bc`."""

    alpha: float = setting(2.5, help="Weight of Q, divided by its mean, against cloning the logged action.", minimum=0)
    smoothing: float = setting(0.2, help="Deviation of the noise on the action that a target judges.", minimum=0)
    smoothing_bound: float = setting(0.5, help="Largest such noise, in each part of the action.", minimum=0)
    actor_every: int = setting(2, help="Steps of the critics from one step of the actor to the next.", minimum=1)


def target(
    batch: Batch, networks: Networks, settings: Td3BcSettings, random: torch.Generator, progress: float
) -> Tensor:
    """Return r + γ min(Q_θ₁'(s', ã), Q_θ₂'(s', ã)) at a noisy action ã of the lagged actor; float [B, T].

        ã = clip(π_φ'(s') + clip(σ ε, -c, c), -1, 1),  ε ~ N(0, 1)

    Source: Fujimoto et al. 2018, "Addressing Function Approximation Error in Actor-Critic Methods", algorithm 1;
    Fujimoto and Gu 2021, "A Minimalist Approach to Offline Reinforcement Learning".
    Differs: 1. Critics are cross-entropy regressions in [0, 1] by default. 2. Lagged networks are copies every
    `--lag-steps` steps; theirs are moving averages.
    """
    image, step = batch.next_states
    action = pointed(networks.lagged["actor"](image, step), networks.specification.action).clamp(-1, 1)
    noise = torch.randn(action.shape, generator=random) * settings.smoothing
    action = (action + noise.clamp(-settings.smoothing_bound, settings.smoothing_bound).to(action)).clamp(-1, 1)
    judged = [cast(QNetwork, networks.lagged[name]).at(image, step)(action.unsqueeze(1)) for name in CRITICS]
    next_value = torch.minimum(*judged)
    return bootstrapped(batch.reward, batch.terminal, batch.before(next_value), settings.discount)


def cloning_actor_critic(
    estimator: Estimator[Td3BcSettings],
    state: TrainState,
    batch: Batch,
    settings: Td3BcSettings,
    random: torch.Generator,
    progress: float,
) -> Metrics:
    """Take one step of both critics, and after every `actor_every`-th one of the actor; return the first one's metrics.

        φ ← φ - optimiser(∇_φ [-λ mean Q_θ₁(s, π_φ(s)) + mean (π_φ(s) - a)²]),  λ = α / mean |Q_θ₁(s, π_φ(s))|

    Source: Fujimoto and Gu 2021, section "A Minimalist Approach to Offline RL".
    Differs: 3. The actor points anywhere within 1.25 times the box and is clipped; its cloning error is that of where
    it points, which leads it back inside. 4. Images are not normalised by the data's mean and deviation.
    """
    networks = state.networks
    wanted = targets_of(estimator, batch, networks, settings, random, progress)
    metrics = step_towards(estimator, state, batch, wanted, settings)
    networks.online["twin"].train()
    twin = dataclasses.replace(networks, online={"q": networks.online["twin"]})
    state.descend("twin", loss_of(estimator, batch, wanted, twin, settings)["loss"])
    if state.step % settings.actor_every != 0:
        return metrics
    actor = networks.online["actor"].train()
    image, step = batch.real(batch.image), batch.real(batch.step)
    networks.q.eval()
    with torch.no_grad(), networks.autocast():
        q_of_actions = networks.q.at(image, step)
    with networks.autocast():
        direction = pointed(actor(image, step), networks.specification.action)
        slope, q = slope_and_q(q_of_actions, direction.detach())
    climb = settings.alpha / q.abs().mean().clamp(min=1e-6) * (slope * direction).sum(-1).mean()
    state.descend("actor", (direction - batch.real(batch.action)).square().mean() - climb)
    return metrics


def slope_and_q(q_of_actions: QOfActions, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Return ∂Q(s, clip(d, -1, 1)) / ∂d, float32 [n, A], and Q there, [n], at where an actor points, d [n, A]."""
    with torch.enable_grad():
        pointing = direction.clone().requires_grad_()
        q = q_of_actions(pointing.clamp(-1, 1).unsqueeze(1)).squeeze(1).float()
        (slope,) = torch.autograd.grad(q.sum(), pointing)
    return slope, q.detach()


row = Estimator(
    summary="Beyond the paper: TD3+BC, an actor that climbs the first of two critics near the logged actions",
    settings=Td3BcSettings,
    target_value=TargetValue("bootstrapped (smaller of two critics)", target, needs_next=True, needs_return=False),
    action_selection=ActorNetwork(),
    paper=Td3BcSettings(loss="squared"),
    recipe=dataclasses.replace(DEFAULT, learning_rate=1e-3),
    parts={
        "q": q_network,
        "twin": q_network,
        "actor": state_network(lambda specification: specification.actions),
    },
    update=cloning_actor_critic,
)
