"""How a run acts: its networks, and the two ways of `selection` to pick an action, asked for one state at a time.

Dimensions: A action, H W C image.
"""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar, NamedTuple, Protocol, cast

import numpy as np
import torch
from torch import Tensor, nn

from graspq.common.action_space import ActionSpace
from graspq.train.networks.network import QNetwork
from graspq.train.search_settings import CemSettings
from graspq.train.selection import SearchSpace, cross_entropy_method, pointed, single_steps
from graspq.train.views import least_of_views

Decision = tuple[Tensor, Tensor | None]
"""An action, float32 [1, A] in [-1, 1], and what it is worth, float32 [1], or None where the run cannot say."""


class ObservedState(NamedTuple):
    """The one state that is decided for, on the networks' device.

    `image` is uint8 [1, H, W, C]; `step` int64 [1], the actions taken so far; `pose` that of the gripper, float32
    [1, A], where it is known: no network sees it.
    """

    image: Tensor
    step: Tensor
    pose: Tensor | None = None


@dataclasses.dataclass(frozen=True)
class Acting:
    """What a run acts with.

    Attributes:
        networks: by part, in evaluation mode.
        kept: tensors that the estimator keeps besides.
        action: what an action means.
        pose_bounds: least and greatest pose that the gripper is commanded to, float [A] each, where they are known.
    """

    networks: Mapping[str, nn.Module]
    kept: Mapping[str, Tensor]
    action: ActionSpace
    pose_bounds: tuple[Tensor, Tensor] | None = None

    @property
    def q(self) -> QNetwork:
        """Q(s, a)."""
        return cast(QNetwork, self.networks["q"])


class ActionSelection(Protocol):
    """How the policy of an estimator finds its action, and the paper's words for it."""

    words: ClassVar[str]

    def act(self, acting: Acting, state: ObservedState, random: np.random.Generator, cem: CemSettings) -> Decision:
        """Return the action for a state, with all noise from `random`; `cem` are the settings of a search."""


class StochasticSearch:
    """The cross-entropy method over the actions of one step."""

    words: ClassVar[str] = "stochastic search"

    def act(self, acting: Acting, state: ObservedState, random: np.random.Generator, cem: CemSettings) -> Decision:
        """Search an action; see `ActionSelection.act`."""
        shape = (cem.iterations, 1, cem.samples, acting.action.size)
        noise = torch.from_numpy(random.standard_normal(shape, dtype=np.float32)).to(state.image.device)
        q_of_actions = least_of_views(acting.q, acting.action, state.image, state.step, cem.views)
        space = self.space(acting, state, noise)
        found = cross_entropy_method(q_of_actions, noise, space, elites=cem.elites, answer=cem.answer)
        return self.executed(found.action.float(), cem).clamp(-1, 1), found.q.float()

    def space(self, acting: Acting, state: ObservedState, near: Tensor) -> SearchSpace:
        """Return where the search starts and may go; tensors of the type and on the device of `near`."""
        return single_steps(acting.action, near)

    def executed(self, found: Tensor, cem: CemSettings) -> Tensor:
        """Return the action, [1, A], for what the search found."""
        return found


class ActorNetwork:
    """The action that the actor network points at: the mean where its policy is a distribution."""

    words: ClassVar[str] = "actor network"

    def act(self, acting: Acting, state: ObservedState, random: np.random.Generator, cem: CemSettings) -> Decision:
        """Ask the actor; its worth is Q(s, a) where there is a Q-function, else V(s). See `ActionSelection.act`."""
        output = acting.networks["actor"](state.image, state.step)[:, : acting.action.size]
        action = pointed(output, acting.action).clamp(-1, 1)
        if "q" in acting.networks:
            return action, acting.q.at(state.image, state.step)(action.unsqueeze(1)).squeeze(1).float()
        value = acting.networks["v"](state.image, state.step) if "v" in acting.networks else None
        return action, None if value is None else value.squeeze(-1).float()
