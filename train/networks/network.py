"""What a Q-network is, and what must be known to build one.

A Q-network computes everything that depends on the state alone once, in its trunk, and judges any number of candidate
actions with a light head. Dimensions: B batch, N candidates, A action, O outputs, H W C image.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, get_args

from torch import Tensor, nn

from graspq.common.action_space import ActionSpace
from graspq.common.errors import UserError
from graspq.common.options import Settings

Features = tuple[Tensor, ...]
Link = Literal["logistic", "identity"]
LARGEST = 10_000  # of what a file may say of images and steps, before anything is allocated by it


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
class NetworkSettings(Settings):
    """Options of a network; those of `--network` follow the common ones."""


@dataclasses.dataclass(frozen=True)
class NetworkSpecification:
    """Everything needed to build a network again: what a checkpoint says about itself.

    Attributes:
        name: of `--network`.
        image_shape: (H, W, C).
        action: what an action means; A is its size.
        steps: T, the most steps of an episode.
        link: what makes Q of a raw output.
        settings: the network's own options, as JSON.
    """

    name: str
    image_shape: tuple[int, int, int]
    action: ActionSpace
    steps: int
    link: Link
    settings: dict[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def actions(self) -> int:
        """A, the number of parts of an action."""
        return self.action.size

    def to_json(self) -> dict[str, Any]:
        """Return the specification as plain JSON values."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return values | {"image_shape": list(self.image_shape), "action": self.action.to_json()}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "NetworkSpecification":
        """Return the specification that `to_json` wrote.

        Raises:
            UserError: a name is missing or unknown, or a value is none that we write.
        """
        names = {field.name for field in dataclasses.fields(cls)}
        if set(values) != names or values["link"] not in get_args(Link):
            raise UserError(f"network specification {values!r}: expected {', '.join(sorted(names))}; train again")
        shape, steps = values["image_shape"], values["steps"]
        right = isinstance(shape, list) and len(shape) == 3 and isinstance(values["settings"], dict)
        if not right or not all(type(size) is int and 1 <= size <= LARGEST for size in (*shape, steps)):
            raise UserError(f"network specification: images of {shape} and {steps} steps; train again")
        return cls(**values | {"image_shape": tuple(shape), "action": ActionSpace.from_json(values["action"])})


class NetworkFamily(NamedTuple):
    """The networks of one `--network`: makers of Q(s, a) and of functions of the state, and their common options."""

    q: Callable[[NetworkSpecification], QNetwork]
    state: Callable[[NetworkSpecification, int], StateNetwork]
    settings: type[NetworkSettings] = NetworkSettings
