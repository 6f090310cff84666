"""The one description of an action: what its parts are, what they command, how they look in the mirror.

A simulator writes it into a manifest; training takes it from there into every checkpoint. A: parts of an action.
"""

import dataclasses
from typing import Any

from graspq.common.errors import UserError

LARGEST = 1e6  # of a limit, whatever its unit


@dataclasses.dataclass(frozen=True)
class ActionSpace:
    """What an action, float32 [A] in [-1, 1], means.

    A pose of the gripper has the same A parts: an action moves each part by its limit at most.

    Attributes:
        names: of the parts, such as `("dx", "dy", "dz", "dphi")`.
        pose: names of the parts of a pose, such as `("x", "y", "z", "phi")`.
        units: of the parts, such as `("m", "m", "m", "rad")`.
        limits: what an action of 1 commands, in these units, each above 0.
        mirror: sign of each part in the mirror image of the scene, 1 or -1; None: the scene has no mirror plane.
        start: where a search for an action begins, each in [-1, 1].
        deviation: standard deviation of the first actions that a search draws.

    Raises:
        UserError: the lengths differ or a number is out of range.
    """

    names: tuple[str, ...]
    pose: tuple[str, ...]
    units: tuple[str, ...]
    limits: tuple[float, ...]
    mirror: tuple[int, ...] | None
    start: tuple[float, ...]
    deviation: float = 0.5

    def __post_init__(self) -> None:
        parts = (self.pose, self.units, self.limits, self.start, *(() if self.mirror is None else (self.mirror,)))
        if not self.names or any(len(part) != len(self.names) for part in parts):
            raise UserError(
                f"action space: expected {len(self.names)} entries of everything, one for each of {self.names}"
            )
        if not all(0 < number <= LARGEST for number in (*self.limits, self.deviation)):
            raise UserError(
                f"action space: expected limits and a deviation above 0, got {self.limits}, {self.deviation}"
            )
        if not set(self.mirror or ()) <= {1, -1} or not all(-1 <= value <= 1 for value in self.start):
            raise UserError(
                f"action space: expected signs of 1 or -1 and a start in [-1, 1], got {self.mirror}, {self.start}"
            )

    @property
    def size(self) -> int:
        """A, the number of parts."""
        return len(self.names)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        values = dataclasses.asdict(self)
        return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "ActionSpace":
        """Return the description that `to_json` wrote.

        Raises:
            UserError: it is none.
        """
        try:
            parts: dict[str, Any] = {
                name: tuple(value) if isinstance(value, list) else value for name, value in values.items()
            }
            return cls(**parts)
        except (TypeError, AttributeError) as error:
            raise UserError(f"action space {values!r}: not a description of an action ({error})") from None


def grasping(limits: tuple[float, ...]) -> ActionSpace:
    """Return the description of graspq's own actions, whose scene is symmetric about the plane y = 0.

    A search starts straight down, (0, 0, -1, 0), as the released code's does and as nine of ten logged actions go.

    Args:
        limits: metres, metres, metres, radians.
    """
    return ActionSpace(
        names=("dx", "dy", "dz", "dphi"),
        pose=("x", "y", "z", "phi"),
        units=("m", "m", "m", "rad"),
        limits=tuple(limits),
        mirror=(1, -1, 1, -1),
        start=(0.0, 0.0, -1.0, 0.0),
    )
