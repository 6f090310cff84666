"""Policies by name: `random`, `oracle`, or a user's own as `module:factory`. Dimension key: A action."""

from typing import Any, Protocol

import numpy as np

from graspq.common.errors import UserError
from graspq.common.named_objects import described, named_object, source_digest
from graspq.policies.random import RandomPolicy
from graspq.sim.observation import Observation
from graspq.sim.play import Policy


class ScoredPolicy(Policy, Protocol):
    """A policy that tells itself from others, so that an evaluation of it is not taken for another one's."""

    def identity(self) -> dict[str, Any]:
        """Return all that determines its actions, as JSON."""


_ROUNDING = 1e-5  # a float32 action may lie this far outside [-1, 1]


class UserPolicy:
    """A user's object with `act(observation, rng)`, its answers checked.

    It may also have `begin(simulation)`, `exploration` and `q`, as `graspq.sim.play.Policy` says. A worker makes one
    object and plays many episodes with it; so that results do not depend on the number of workers, what it answers
    may depend on what it saw since the episode began and on `rng` alone.

    Attributes:
        name: `module:factory`.
        exploration: the object's, else 0.
    """

    def __init__(self, name: str) -> None:
        """Import `module:factory` (from the working folder too) and call the factory.

        Raises:
            UserError: the module or the factory is missing or fails, or its result cannot act.
        """
        self.name = name
        factory = named_object(name, "policy")
        try:
            self._own = factory()
        except Exception as error:
            raise UserError(f"policy {name}: cannot be made, {described(error)}") from error
        if not callable(getattr(self._own, "act", None)):
            found = type(self._own).__name__
            raise UserError(
                f"policy {name}: expected an object with act(observation, rng), the factory returned {found}"
            )
        self.exploration = float(getattr(self._own, "exploration", 0.0))
        self._parts = 4

    @property
    def q(self) -> float | None:
        """Q of the action just given, if the object says so."""
        return getattr(self._own, "q", None)

    def begin(self, simulation: Any) -> None:
        """Let the object look at the scene of an episode, if it cares."""
        self._parts = simulation.task.action.size
        if callable(getattr(self._own, "begin", None)):
            self._asked("begin", simulation)

    def act(self, observation: Observation, rng: np.random.Generator) -> np.ndarray:
        """Return the object's action, float32 [A] in [-1, 1].

        Raises:
            UserError: it fails, or returns something else than A finite numbers in [-1, 1].
        """
        answer = self._asked("act", observation, rng)
        wanted = f"expected {self._parts} finite numbers in [-1, 1]"
        try:
            values = np.asarray(answer, dtype=np.float32)
        except (TypeError, ValueError):
            raise UserError(f"policy {self.name}: act() returned {type(answer).__name__}, {wanted}") from None
        if values.shape != (self._parts,):
            raise UserError(f"policy {self.name}: act() returned the shape {list(values.shape)}, {wanted}")
        if not np.isfinite(values).all() or np.abs(values).max() > 1 + _ROUNDING:
            worst = values[int(np.argmax(np.where(np.isfinite(values), np.abs(values), np.inf)))]
            raise UserError(f"policy {self.name}: act() returned {worst}, {wanted}")
        clipped: np.ndarray = np.clip(values, -1, 1)
        return clipped

    def identity(self) -> dict[str, Any]:
        """Return the digest of its source file, so that a changed policy is not taken for a finished job."""
        return {"source_sha256": source_digest(self.name)}

    def _asked(self, method: str, *arguments: Any) -> Any:
        try:
            return getattr(self._own, method)(*arguments)
        except Exception as error:
            raise UserError(f"policy {self.name}: {method}() failed, {described(error)}") from error

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel by name: a worker imports the module and makes an object of its own."""
        return UserPolicy, (self.name,)


def policy_named(name: str) -> ScoredPolicy:
    """Return a policy by its name.

    Raises:
        UserError: it is unknown, or a user's own cannot be made.
    """
    if name == "random":
        return RandomPolicy()
    if name == "oracle":
        # Imported late: it needs the simulator.
        from graspq.policies.oracle import Oracle

        return Oracle()
    if ":" not in name:
        raise UserError(f"policy {name!r}: expected random, oracle, or module:factory of your own")
    return UserPolicy(name)
