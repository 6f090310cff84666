"""The policy of a trained actor network: one pass for a decision, no search and no noise.

Dimension key: B batch rows, A action, H W C image.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

import numpy as np
import torch
from torch import Tensor, nn

from graspq.evaluate.policies import ACTION_DIMENSIONS, Decision, Policy
from graspq.train.selection import pointed

if TYPE_CHECKING:
    from graspq.train.networks import QNetwork
    from graspq.train.state import Networks


class ActorPolicy(Policy):
    """Acts as the actor network points, clipped to [-1, 1]: the mean where the actor is a distribution (`pcl`).

    The reported q is Q(s, a) where the run has a Q-function (`ddpg`), else V(s) (`pcl`), which is on the same scale.
    """

    def __init__(self, networks: "Networks", device: torch.device) -> None:
        self.actor = _ready(networks["actor"], device)
        self.q = _ready(networks["q"], device) if "q" in networks else None
        self.v = _ready(networks["v"], device) if "v" in networks else None
        self.device = device

    def decide(
        self,
        images: np.ndarray,
        steps: np.ndarray,
        generators: Sequence[np.random.Generator | None],
        poses: np.ndarray | None = None,
    ) -> Decision:
        """Return the actor's action for each state; the generators are not used. See `Policy.decide`."""
        with torch.inference_mode():
            image = torch.from_numpy(np.ascontiguousarray(images)).to(self.device)
            step = torch.from_numpy(np.asarray(steps, dtype=np.int64)).to(self.device)
            action = pointed(self.actor(image, step)[:, :ACTION_DIMENSIONS]).clamp(-1, 1)
            value = self._value(image, step, action)
            return Decision(action.float().cpu().numpy(), None if value is None else value.float().cpu().numpy())

    def _value(self, image: Tensor, step: Tensor, action: Tensor) -> Tensor | None:
        if self.q is not None:
            return cast("QNetwork", self.q).at(image, step)(action.unsqueeze(1)).squeeze(1)
        return cast(Tensor, self.v(image, step)).squeeze(-1) if self.v is not None else None


def _ready(network: nn.Module, device: torch.device) -> nn.Module:
    return network.to(device).eval()
