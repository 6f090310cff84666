"""`iql`: implicit Q-learning. V(s) is an upper expectile of Q over logged actions; no target judges any other action.

Beyond the paper. Derivation: docs/estimators/iql.md. Dimensions: n real states, B batch, T = 1 step, A action.
"""

import dataclasses
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from graspq.common.options import setting
from graspq.train.acting import Acting, ActorNetwork, Decision, ObservedState, StochasticSearch
from graspq.train.batch import Batch
from graspq.train.estimator import Estimator, LaggedSettings, Metrics, RegressionSettings, TargetValue, regression
from graspq.train.networks import q_network, state_network
from graspq.train.search_settings import CemSettings
from graspq.train.selection import pointed
from graspq.train.state import Networks, TrainState
from graspq.train.targets import bootstrapped

LARGEST_WEIGHT = 100.0


@dataclasses.dataclass(frozen=True)
class IqlSettings(LaggedSettings, RegressionSettings):
    """Options of `iql`."""

    expectile: float = setting(
        0.9,
        help="Expectile of Q over logged actions that V is: 0.5 is their mean, near 1 the best.",
        minimum=0.5,
        maximum=0.999,
    )
    policy: Literal["search", "actor"] = setting(
        "search", help="Act by stochastic search over Q, or by an actor network of its own."
    )
    sharpness: float = setting(
        10.0, help="Of the actor's weights exp(sharpness * advantage) of logged actions.", minimum=0
    )

    @property
    def unused_parts(self) -> frozenset[str]:
        """The actor, unless it acts."""
        return frozenset() if self.policy == "actor" else frozenset({"actor"})


class SearchOrActor(StochasticSearch):
    """Stochastic search, or the actor network of a run that has one."""

    def act(self, acting: Acting, state: ObservedState, random: np.random.Generator, cem: CemSettings) -> Decision:
        """Search, or ask the actor; see `ActionSelection.act`."""
        if "actor" in acting.networks:
            return ActorNetwork().act(acting, state, random, cem)
        return super().act(acting, state, random, cem)


def target(batch: Batch, networks: Networks, settings: IqlSettings, random: torch.Generator, progress: float) -> Tensor:
    """Return r + γ V(s'); float [B, T]. See `targets.bootstrapped`.

    Source: Kostrikov et al. 2022, "Offline Reinforcement Learning with Implicit Q-Learning", equation 6.
    Differs: 1. Q is a cross-entropy regression in [0, 1] by default, V an unbounded number. 2. One Q, not the smaller
    of two. 3. V follows a copy of Q made every `--lag-steps` steps; theirs is a moving average. 4. The policy searches
    Q; theirs is the actor (`--policy actor`).
    """
    image, step = batch.next_states
    next_value = batch.before(networks.online["v"](image, step))
    return bootstrapped(batch.reward, batch.terminal, next_value, settings.discount)


def expectile_loss(error: Tensor, expectile: float) -> Tensor:
    """Return |τ - 1(u < 0)| u² of errors u = Q - V, float [n]: least, in the mean, where V is the τ-expectile of Q.

    Source: Kostrikov et al. 2022, equation 5.
    """
    return torch.where(error < 0, 1 - expectile, expectile) * error.square()


def implicit_q_learning(
    estimator: Estimator[IqlSettings],
    state: TrainState,
    batch: Batch,
    settings: IqlSettings,
    random: torch.Generator,
    progress: float,
) -> Metrics:
    """Take one step of V, one of the actor where there is one, and one of Q.

        V ← V - optimiser(∇ mean |τ - 1(u < 0)| u²),  u = Q_θ'(s_t, a_t) - V(s_t)
        π ← π - optimiser(∇ mean w ½ ‖a_t - π(s_t)‖²),  w = min(exp(β u), 100)
        Q ← a step of regression onto r + γ V(s')

    Source: Kostrikov et al. 2022, algorithm 1; the actor's is equation 7.
    Differs: 5. The actor is a normal distribution of fixed deviation, so its loss a weighted squared error; their
    deviation is learned.
    """
    networks = state.networks
    image, step, action = batch.real(batch.image), batch.real(batch.step), batch.real(batch.action)
    with torch.no_grad(), networks.autocast():
        q = networks.lagged_q.at(image, step)(action.unsqueeze(1)).squeeze(1).float()
    value_network = networks.online["v"].train()
    with networks.autocast():
        value = value_network(image, step).squeeze(-1).float()
    state.descend("v", expectile_loss(q - value, settings.expectile).mean())
    value = value.detach()
    if settings.policy == "actor":
        weight = (settings.sharpness * (q - value)).exp().clamp(max=LARGEST_WEIGHT)
        actor = networks.online["actor"].train()
        with networks.autocast():
            direction = pointed(actor(image, step), networks.specification.action)
        state.descend("actor", (weight * 0.5 * (action - direction).square().sum(-1)).mean())
    return regression(estimator, state, batch, settings, random, progress) | {"v": value.abs().mean()}


row = Estimator(
    summary="Beyond the paper: implicit Q-learning, V is an upper expectile of Q over logged actions",
    settings=IqlSettings,
    target_value=TargetValue(
        "bootstrapped (expectile of Q over logged actions)", target, needs_next=True, needs_return=False
    ),
    action_selection=SearchOrActor(),
    paper=IqlSettings(loss="squared"),
    parts={
        "q": q_network,
        "v": state_network(1),
        "actor": state_network(lambda specification: specification.actions),
    },
    update=implicit_q_learning,
)
