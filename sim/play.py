"""The one loop that plays an episode: collection, evaluation and films differ in who acts and in what they keep.

Dimension key: T steps of an episode, A parts of an action, H W C image, K objects.
"""

import dataclasses
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np

from graspq.sim.observation import Observation

if TYPE_CHECKING:
    from graspq.sim.episode import GraspSimulation


class Policy(Protocol):
    """Who acts. Two more parts are optional.

    `begin(simulation)` is called before an episode, for a policy that looks into the simulation, such as the oracle;
    an attribute `q` holds the Q-value of the action just given, or None.
    """

    @property
    def name(self) -> str:
        """What the episodes table calls it."""

    @property
    def exploration(self) -> float:
        """Its exploration parameter, for the episodes table."""

    def act(self, observation: Observation, rng: np.random.Generator) -> np.ndarray:
        """Return an action, float32 [A] in [-1, 1]; all its noise comes from `rng`, one stream for each episode."""


@dataclasses.dataclass(frozen=True)
class Played:
    """What happened in one episode.

    Attributes:
        object_poses: after settling, float32 [K, 7]: position (metres) and quaternion (xyzw) of each object.
        observations: T of them, before each action.
        actions: float32 [T, A].
        rewards: float32 [T]; 0 but for the last.
        last: the frame after the lift, uint8 [H, W, C].
        ended_by: "height" (the gripper came below its trigger height) or "T" (the last step).
        success: whether the grasp counted.
        lifted_object: id of the object that was lifted; None if none was.
        final_pose: float32 [A], measured after the last action and before the scripted descent.
        q: Q-value of the last action; None where the policy has none.
    """

    object_poses: np.ndarray
    observations: tuple[Observation, ...]
    actions: np.ndarray
    rewards: np.ndarray
    last: np.ndarray
    ended_by: Literal["height", "T"]
    success: bool
    lifted_object: str | None
    final_pose: np.ndarray
    q: float | None

    @property
    def frames(self) -> np.ndarray:
        """All views, uint8 [T + 1, H, W, C]."""
        return np.stack([*(observation.image for observation in self.observations), self.last])


def play(simulation: "GraspSimulation", policy: Policy, rng: np.random.Generator) -> Played:
    """Play an episode that `simulation.reset` has just started to its end.

    Args:
        simulation: at the start of an episode.
        policy: who acts.
        rng: the policy's noise.

    Raises:
        RuntimeError: no episode was started.
        ValueError: the policy gave something else than A finite numbers.
    """
    object_poses = simulation.object_poses()
    if hasattr(policy, "begin"):
        policy.begin(simulation)
    observations, actions, rewards = [], [], []
    observation, terminated = simulation.observation, False
    while not terminated:
        action = policy.act(observation, rng)
        outcome = simulation.step(action)
        observations.append(observation)
        actions.append(action)
        rewards.append(outcome.reward)
        observation, terminated = outcome.observation, outcome.terminated
    q = getattr(policy, "q", None)
    return Played(
        object_poses=object_poses,
        observations=tuple(observations),
        actions=np.stack(actions).astype(np.float32, copy=False),
        rewards=np.asarray(rewards, dtype=np.float32),
        last=observation.image,
        ended_by=outcome.info["ended_by"],
        success=outcome.info["success"],
        lifted_object=outcome.info["lifted_object"],
        final_pose=outcome.info["final_pose"],
        q=None if q is None else float(q),
    )
