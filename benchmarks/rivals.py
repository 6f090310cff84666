"""The usual ways to ask a Q-function for the values of CEM's candidates, as rivals of `QNetwork.at`.

Dimension key: B states, N candidates, A action.
"""

import dataclasses
from collections.abc import Callable

from torch import Tensor, nn

from graspq.policies.of_run import RunPolicy
from graspq.train.networks.network import QNetwork
from graspq.train.selection import QOfActions

Way = Callable[[QNetwork, Tensor, Tensor], QOfActions]


def tiled(network: QNetwork, image: Tensor, step: Tensor) -> QOfActions:
    """Return Q of candidates [B, N, A] by the whole network on N copies of every image."""

    def q_of_actions(action: Tensor) -> Tensor:
        batch, candidates = action.shape[:2]
        copies = image.repeat_interleave(candidates, dim=0)
        output = network(copies, step.repeat_interleave(candidates), action.flatten(0, 1))
        return network.value_of(output).view(batch, candidates)

    return q_of_actions


TILED, ANEW, ONCE = "64 tiled copies", "trunk each iteration", "trunk once"
WAYS: dict[str, Way] = {
    TILED: tiled,
    ANEW: lambda network, image, step: lambda action: network.at(image, step)(action),
    ONCE: lambda network, image, step: network.at(image, step),  # as we do
}


class Asked(nn.Module):
    """A Q-network to a policy that searches, asked for values in one of `WAYS`."""

    def __init__(self, network: QNetwork, way: str) -> None:
        super().__init__()
        self.network, self.way = network, way

    def at(self, image: Tensor, step: Tensor) -> QOfActions:
        """Return Q of candidate actions in these states; see `QNetwork.at`."""
        return WAYS[self.way](self.network, image, step)


def asking(policy: RunPolicy, way: str) -> RunPolicy:
    """Return a policy that searches the same, and asks for values in one of `WAYS`."""
    networks = {**policy.acting.networks, "q": Asked(policy.acting.q, way)}
    acting = dataclasses.replace(policy.acting, networks=networks)
    return RunPolicy(policy.origin, acting, policy.selection, policy.cem, policy.device)
