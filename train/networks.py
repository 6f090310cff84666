"""What a Q-network is, and the table of networks that `--network` chooses from.

A Q-network computes everything that depends on the state alone once, in its trunk, and judges any number of candidate
actions with a light head. Dimensions: B batch, N candidates, A action, O outputs, H W C image.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, TypeVar, get_args

import torch
from torch import Tensor, nn

from graspq.common.errors import UserError

Features = tuple[Tensor, ...]
Link = Literal["logistic", "identity"]


class QNetwork(nn.Module):
    """A Q-function Q_θ(s, a) in two parts: `trunk` reads the state, `head` judges actions in it."""

    link: Link = "logistic"

    def trunk(self, image: Tensor, step: Tensor) -> Features:
        """Return the features of states.

        Args:
            image: uint8 [B, H, W, C].
            step: int64 [B], 0 at the first step of an episode.

        Returns:
            Tensors with leading dimension B.
        """
        raise NotImplementedError

    def head(self, features: Features, action: Tensor) -> Tensor:
        """Return the network's raw output for candidate actions, float32 [B, N].

        Args:
            features: what `trunk` returned.
            action: float [B, N, A] in units of the action limits.
        """
        raise NotImplementedError

    def forward(self, image: Tensor, step: Tensor, action: Tensor) -> Tensor:
        """Return the raw output for one action [B, A] in each state; float32 [B]."""
        return self.head(self.trunk(image, step), action.unsqueeze(1)).squeeze(1)

    def value_of(self, output: Tensor) -> Tensor:
        """Return Q for raw outputs: their logistic function in [0, 1], or themselves."""
        return output.sigmoid() if self.link == "logistic" else output

    def at(self, image: Tensor, step: Tensor) -> Callable[[Tensor], Tensor]:
        """Return Q as a function of candidate actions, [B, N, A] -> [B, N], in these states; the trunk runs here, once.

        Args:
            image: uint8 [B, H, W, C].
            step: int64 [B].
        """
        features = self.trunk(image, step)
        return lambda action: self.value_of(self.head(features, action))


class StateNetwork(nn.Module):
    """A function of the state alone: V(s), or what an actor's action is made of."""

    def forward(self, image: Tensor, step: Tensor) -> Tensor:
        """Return raw outputs, float32 [B, O].

        Args:
            image: uint8 [B, H, W, C].
            step: int64 [B], 0 at the first step of an episode.
        """
        raise NotImplementedError


@dataclasses.dataclass(frozen=True)
class NetworkSpecification:
    """Everything needed to build a network again: what a checkpoint says about itself.

    `image_shape` is (H, W, C), `actions` the number of action dimensions, `steps` T, the most steps of an episode.
    `width` is the number of channels and units of the paper's network; the default network has its own.
    """

    name: str
    image_shape: tuple[int, int, int]
    actions: int
    steps: int
    link: Link
    width: int = 32

    def to_json(self) -> dict[str, Any]:
        """Return the specification as plain JSON values."""
        return dataclasses.asdict(self) | {"image_shape": list(self.image_shape)}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "NetworkSpecification":
        """Return the specification that `to_json` wrote.

        Raises:
            UserError: a name is missing or unknown, or the link is.
        """
        names = {field.name for field in dataclasses.fields(cls)}
        if set(values) != names or values["link"] not in get_args(Link) or len(values["image_shape"]) != 3:
            raise UserError(f"network specification {values!r}: expected {', '.join(sorted(names))}; train again")
        height, width, channels = values["image_shape"]
        return cls(**values | {"image_shape": (int(height), int(width), int(channels))})


def make_network(specification: NetworkSpecification, generator: torch.Generator | None = None) -> QNetwork:
    """Return a freshly initialised Q-network on the CPU.

    Args:
        specification: which network, for which states and actions.
        generator: seeds the initial weights: they are a function of its next draw. Without one they follow torch's
            global generator, which is right only where a checkpoint overwrites them.

    Raises:
        UserError: the name is unknown, or the images are too small for the network.
    """
    network = _seeded(generator, lambda: _family(specification).q(specification))
    network.link = specification.link
    # torch's annotations do not know that modules take a memory format.
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]


def make_state_network(
    specification: NetworkSpecification, outputs: int, generator: torch.Generator | None = None
) -> StateNetwork:
    """Return a freshly initialised function of the state with O = `outputs` outputs; see `make_network`."""
    network = _seeded(generator, lambda: _family(specification).state(specification, outputs))
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]


Module = TypeVar("Module", bound=nn.Module)


def _seeded(generator: torch.Generator | None, make: Callable[[], Module]) -> Module:
    if generator is None:
        return make()
    seed = int(torch.randint(2**62, (), generator=generator))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return make()


class _Family(NamedTuple):
    """The networks of one `--network`."""

    q: Callable[[NetworkSpecification], QNetwork]
    state: Callable[[NetworkSpecification, int], StateNetwork]


def _family(specification: NetworkSpecification) -> _Family:
    if specification.name not in NETWORKS:
        raise UserError(f"--network: {specification.name!r} is unknown; choose from {', '.join(NETWORKS)}")
    return NETWORKS[specification.name]()


def _paper() -> _Family:
    from graspq.train.paper_network import PaperNetwork, PaperStateNetwork

    return _Family(PaperNetwork, PaperStateNetwork)


def _default() -> _Family:
    from graspq.train.default_network import DefaultNetwork, DefaultStateNetwork

    return _Family(DefaultNetwork, DefaultStateNetwork)


NETWORKS: dict[str, Callable[[], _Family]] = {
    "default": _default,
    "paper": _paper,
}
