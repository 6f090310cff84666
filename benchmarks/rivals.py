"""The usual ways to ask a Q-function for the values of CEM's candidates, as rivals of `QNetwork.at`.

Dimension key: B states, N candidates, A action.
"""

import copy
from collections.abc import Callable

from torch import Tensor

from graspq.evaluate.q_policy import QPolicy
from graspq.train.networks import QNetwork
from graspq.train.selection import QOfActions


def tiled(network: QNetwork, image: Tensor, step: Tensor) -> QOfActions:
    """Return Q of candidates [B, N, A] by the whole network on N copies of every image."""

    def q_of_actions(action: Tensor) -> Tensor:
        batch, candidates = action.shape[:2]
        copies = image.repeat_interleave(candidates, dim=0)
        output = network(copies, step.repeat_interleave(candidates), action.flatten(0, 1))
        return network.value_of(output).view(batch, candidates)

    return q_of_actions


def anew(network: QNetwork, image: Tensor, step: Tensor) -> QOfActions:
    """Return Q of candidates by a trunk that runs again at every call."""
    return lambda action: network.at(image, step)(action)


def once(network: QNetwork, image: Tensor, step: Tensor) -> QOfActions:
    """Return Q of candidates by a trunk that runs once, as we do."""
    return network.at(image, step)


WAYS: dict[str, Callable[[QNetwork, Tensor, Tensor], QOfActions]] = {
    "64 tiled copies": tiled,
    "trunk each iteration": anew,
    "trunk once": once,
}


class _Asked:
    """A Q-network to a policy, which asks for values in another way."""

    def __init__(self, network: QNetwork, way: str) -> None:
        self._network, self._way = network, WAYS[way]

    def at(self, image: Tensor, step: Tensor) -> QOfActions:
        """Return Q of candidate actions in these states; see `QNetwork.at`."""
        return self._way(self._network, image, step)


def asking(policy: QPolicy, way: str) -> QPolicy:
    """Return a copy of a policy that searches the same, and asks for values in one of `WAYS`."""
    rival = copy.copy(policy)
    rival.network = _Asked(policy.network, way)  # type: ignore[assignment]
    return rival
