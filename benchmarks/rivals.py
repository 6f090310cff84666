"""The usual ways to ask a Q-function for the values of CEM's candidates, as rivals of `QNetwork.at`.

Dimension key: B states, N candidates, A action.
"""

from collections.abc import Callable

from torch import Tensor

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


def anew(network: QNetwork, image: Tensor, step: Tensor) -> QOfActions:
    """Return Q of candidates by a trunk that runs again at every call."""
    return lambda action: network.at(image, step)(action)


def once(network: QNetwork, image: Tensor, step: Tensor) -> QOfActions:
    """Return Q of candidates by a trunk that runs once, as we do."""
    return network.at(image, step)


TILED, ANEW, ONCE = "64 tiled copies", "trunk each iteration", "trunk once"
WAYS: dict[str, Way] = {TILED: tiled, ANEW: anew, ONCE: once}
