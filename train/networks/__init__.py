"""The table of networks that `--network` chooses from: a file each, or a user's own as `module:network`.

A network's file says how its Q(s, a) and its functions of the state alone are made, and which options it has.
"""

from collections.abc import Callable, Mapping
from typing import TypeVar

import torch
from torch import nn

from graspq.common.named_objects import named_row
from graspq.train.networks import default, paper
from graspq.train.networks.network import NetworkFamily, NetworkSpecification, QNetwork

NETWORKS: dict[str, NetworkFamily] = {"default": default.network, "paper": paper.network}

Maker = Callable[[NetworkSpecification], nn.Module]
Parts = Mapping[str, Maker]
"""The networks of an estimator by the names of its own: `q` is Q(s, a), `v` V(s), `actor` what an action is made of."""
Module = TypeVar("Module", bound=nn.Module)


def network_named(name: str) -> NetworkFamily:
    """Return the networks of `--network`: one of the table's, or a user's own as `module:network`.

    Raises:
        UserError: there is none of that name, or what is there is none.
    """
    return named_row("--network", name, NETWORKS, NetworkFamily, "network")


def q_network(specification: NetworkSpecification) -> nn.Module:
    """Return Q(s, a) of the specification's `--network`: the maker of the part `q` of most estimators."""
    return network_named(specification.name).q(specification)


def state_network(outputs: int | Callable[[NetworkSpecification], int]) -> Maker:
    """Return a maker of functions of the state with so many outputs, a number or a function of the specification."""

    def make(specification: NetworkSpecification) -> nn.Module:
        count = outputs if isinstance(outputs, int) else outputs(specification)
        return network_named(specification.name).state(specification, count)

    return make


def build(maker: Maker, specification: NetworkSpecification, generator: torch.Generator | None = None) -> nn.Module:
    """Return a freshly initialised network on the CPU.

    Args:
        maker: of a part of an estimator.
        specification: which network, for which states and actions.
        generator: seeds the initial weights: they are a function of its next draw. Without one they follow torch's
            global generator, which is right only where a checkpoint overwrites them.

    Raises:
        UserError: the name is unknown, or the images are too small for the network.
    """
    if generator is None:
        network = maker(specification)
    else:
        seed = int(torch.randint(2**62, (), generator=generator))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = maker(specification)
    if isinstance(network, QNetwork):
        network.link = specification.link
    # torch's annotations do not know that modules take a memory format.
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]
