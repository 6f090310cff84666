"""Policies that see the image and the step alone: trained Q-functions, the random policy, a user's own.

`Policy.from_run(path).act(image, step)` is all that a robot's control loop needs. Dimension key: N states, H W C image.
"""

import abc
import inspect
import os
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from graspq.common.errors import UserError
from graspq.common.files import sha256_of
from graspq.common.named_objects import named_module
from graspq.common.seeding import generator
from graspq.evaluate.records import ORACLE as ORACLE
from graspq.evaluate.records import RANDOM as RANDOM
from graspq.evaluate.settings import CemSettings, Device

CEM, ACTOR = "cem", "actor"  # what eval.json calls the policies of runs
ACTION_DIMENSIONS = 4
_ROUNDING = 1e-5  # a float32 action may lie this far outside [-1, 1]


class Decision(NamedTuple):
    """What a policy decided for N states.

    Attributes:
        actions: float32 [N, 4] in [-1, 1], (dx, dy, dz, dphi) in units of the action limits.
        q: float32 [N], Q of those actions as a probability of success; None where there is no Q-function.
    """

    actions: np.ndarray
    q: np.ndarray | None


class Policy(abc.ABC):
    """Decides on images and steps; its noise comes from generators that are handed in, one for each state."""

    _own: np.random.Generator | None = None

    @staticmethod
    def from_run(
        path: str | Path,
        *,
        checkpoint: int | None = None,
        cem: CemSettings | None = None,
        seed: int = 0,
        device: Device = "auto",
    ) -> "Policy":
        """Return the policy of a training run: CEM over its Q-function, or its actor (`ddpg`, `pcl`).

        Args:
            path: the run's folder.
            checkpoint: training step of the checkpoint; the last one by default.
            cem: settings of the search.
            seed: of the generator that `act` draws from.
            device: where the network runs; `auto` takes a GPU if there is one.

        Raises:
            UserError: the folder holds no run, no such checkpoint, or a damaged one.
        """
        from graspq.evaluate.runs import load_run

        policy, _ = load_run(Path(path), checkpoint, cem or CemSettings(), device)
        policy.seed(seed)
        return policy

    @abc.abstractmethod
    def decide(
        self,
        images: np.ndarray,
        steps: np.ndarray,
        generators: Sequence[np.random.Generator | None],
        poses: np.ndarray | None = None,
    ) -> Decision:
        """Decide for N states; a state's decision does not depend on the others.

        Args:
            images: uint8 [N, H, W, 3] RGB.
            steps: int64 [N], actions taken so far, 0 .. T-1.
            generators: the noise of each state; None marks a row that nobody waits for, its action means nothing.
            poses: of the gripper, float [N, 4] = (x, y, z, φ), metres and radians. No network sees them; a policy that
                searches motions to a last pose keeps that inside the workspace by them, where they are given.
        """

    def act_batch(
        self,
        images: np.ndarray,
        steps: np.ndarray,
        generators: Sequence[np.random.Generator],
        poses: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the actions for N states, float32 [N, 4]; see `decide`."""
        return self.decide(images, steps, generators, poses).actions

    def act(self, image: np.ndarray, step: int, pose: np.ndarray | None = None) -> np.ndarray:
        """Return the action for one state, float32 [4]; noise comes from the policy's own generator, see `seed`."""
        if self._own is None:
            self.seed(0)
        assert self._own is not None
        poses = None if pose is None else np.asarray(pose)[None]
        steps = np.asarray([step], dtype=np.int64)
        action: np.ndarray = self.decide(np.asarray(image)[None], steps, [self._own], poses).actions[0]
        return action

    def seed(self, seed: int) -> None:
        """Start the generator of `act` anew."""
        self._own = generator("evaluate/act", seed)

    def identity(self) -> dict[str, Any]:
        """Return what tells this policy from others, for `eval.json`."""
        return {}


class RandomObservationPolicy(Policy):
    """The random policy of the collection; it looks at nothing."""

    def __init__(self) -> None:
        from graspq.policies.random import RandomPolicy

        self._policy = RandomPolicy()

    def decide(
        self,
        images: np.ndarray,
        steps: np.ndarray,
        generators: Sequence[np.random.Generator | None],
        poses: np.ndarray | None = None,
    ) -> Decision:
        """Draw an action for each state from its own generator."""
        actions = np.zeros((len(steps), ACTION_DIMENSIONS), dtype=np.float32)
        for row, own in enumerate(generators):
            if own is not None:
                actions[row] = self._policy.act(None, own)
        return Decision(actions, None)

    def identity(self) -> dict[str, Any]:
        """Return its settings."""
        return {"random": self._policy.to_json()}


class UserPolicy(Policy):
    """A user's object with `act(image, step)` and perhaps `act_batch(images, steps, generators)`."""

    def __init__(self, name: str, wrapped: Any, source: Path | None) -> None:
        self.name, self._wrapped, self._source = name, wrapped, source
        if not callable(getattr(wrapped, "act", None)) and not callable(getattr(wrapped, "act_batch", None)):
            found = type(wrapped).__name__
            raise UserError(f"policy {name}: expected an object with act(image, step), the factory returned {found}")

    @classmethod
    def load(cls, name: str) -> "UserPolicy":
        """Import `module:factory` (from the working folder too) and call the factory.

        Raises:
            UserError: the module or the factory is missing or fails, or its result cannot act.
        """
        module_name, _, factory_name = name.partition(":")
        if not module_name or not factory_name:
            raise UserError(f"policy {name!r}: expected random, oracle, or module:factory of your own")
        try:
            module = named_module(module_name)
            factory = getattr(module, factory_name, None)
            if not callable(factory):
                raise UserError(f"policy {name}: {module_name} has no function {factory_name!r}")
            wrapped = factory()
        except UserError:
            raise
        except Exception as error:
            raise UserError(f"policy {name}: cannot be made, {_described(error)}") from error
        source = inspect.getsourcefile(module)
        return cls(name, wrapped, Path(source) if source is not None else None)

    def decide(
        self,
        images: np.ndarray,
        steps: np.ndarray,
        generators: Sequence[np.random.Generator | None],
        poses: np.ndarray | None = None,
    ) -> Decision:
        """Ask the user's object and check what it says.

        Raises:
            UserError: it fails, or returns something else than finite numbers in [-1, 1] of the right shape.
        """
        rows = [row for row, own in enumerate(generators) if own is not None]
        actions = np.zeros((len(steps), ACTION_DIMENSIONS), dtype=np.float32)
        if not rows:
            return Decision(actions, None)
        if callable(getattr(self._wrapped, "act_batch", None)):
            answer = self._asked("act_batch", images[rows], steps[rows], [generators[row] for row in rows])
            actions[rows] = self._checked("act_batch", answer, (len(rows), ACTION_DIMENSIONS))
        else:
            for row in rows:
                answer = self._asked("act", images[row], int(steps[row]))
                actions[row] = self._checked("act", answer, (ACTION_DIMENSIONS,))
        return Decision(actions, None)

    def identity(self) -> dict[str, Any]:
        """Return the digest of its source file, so that a changed policy is not taken for a finished job."""
        return {"source_sha256": sha256_of(self._source) if self._source is not None else None}

    def _asked(self, method: str, *arguments: Any) -> Any:
        try:
            return getattr(self._wrapped, method)(*arguments)
        except Exception as error:
            raise UserError(f"policy {self.name}: {method}() failed, {_described(error)}") from error

    def _checked(self, method: str, answer: Any, shape: tuple[int, ...]) -> np.ndarray:
        wanted = f"expected {' x '.join(map(str, shape))} finite numbers in [-1, 1]"
        try:
            values = np.asarray(answer, dtype=np.float32)
        except (TypeError, ValueError):
            raise UserError(f"policy {self.name}: {method}() returned {type(answer).__name__}, {wanted}") from None
        if values.shape != shape:
            raise UserError(f"policy {self.name}: {method}() returned the shape {list(values.shape)}, {wanted}")
        if not np.isfinite(values).all() or np.abs(values).max() > 1 + _ROUNDING:
            worst = values.flat[int(np.argmax(np.where(np.isfinite(values), np.abs(values), np.inf)))]
            raise UserError(f"policy {self.name}: {method}() returned {worst}, {wanted}")
        clipped: np.ndarray = np.clip(values, -1, 1)
        return clipped


def _described(error: Exception) -> str:
    """Return an error with the place it was raised at, in one line."""
    frames = traceback.extract_tb(error.__traceback__)
    where = f" at {os.path.relpath(frames[-1].filename)}:{frames[-1].lineno}" if frames else ""
    return f"{type(error).__name__}: {error}{where}"
