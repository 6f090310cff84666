"""One block of episodes as a pure function of the dataset's settings and the block's number.

A block is 20 episodes that share their objects; it starts from an emptied world, so it gives the same bytes alone,
after any other blocks, and in any process. Dimension key: T steps of an episode, H W C image.
"""

import dataclasses
from typing import Protocol

import numpy as np

from graspq.common.seeding import generator, integer_seed
from graspq.datagen.settings import CollectionSettings
from graspq.datasets.episode import Episode
from graspq.sim.episode import GraspSimulation
from graspq.sim.policies import RandomPolicy
from graspq.sim.task import draw_objects


class CollectingPolicy(Protocol):
    """Who acts in a collection; all its noise comes from the generator that it is handed."""

    @property
    def name(self) -> str:
        """What the episodes table calls it."""

    @property
    def exploration(self) -> float:
        """Its exploration parameter, for the episodes table."""

    def act(
        self, image: np.ndarray, step: int, draws: np.random.Generator, pose: np.ndarray | None = None
    ) -> np.ndarray:
        """Return an action, float32 [4] in [-1, 1].

        Args:
            image: uint8 [H, W, 3] RGB.
            step: actions taken so far, 0 .. T-1.
            draws: one stream for each episode.
            pose: of the gripper, float32 [4] = (x, y, z, φ), metres and radians; for searches that end in a workspace.
        """


@dataclasses.dataclass(frozen=True)
class BlindPolicy:
    """The random policy as a `CollectingPolicy`: it looks at nothing."""

    name: str
    random: RandomPolicy

    @property
    def exploration(self) -> float:
        """Its probability of moving straight down."""
        return self.random.descend_probability

    def act(
        self, image: np.ndarray, step: int, draws: np.random.Generator, pose: np.ndarray | None = None
    ) -> np.ndarray:
        """Return a random action, float32 [4]."""
        return self.random.act(draws)


def collect_block(
    simulation: GraspSimulation,
    settings: CollectionSettings,
    block: int,
    episodes: int,
    policy: CollectingPolicy | None = None,
    first_episode: int | None = None,
) -> list[Episode]:
    """Return the first `episodes` episodes of a block.

    Args:
        simulation: any simulation of the dataset's task and object set; what it did before does not matter.
        settings: of the dataset.
        block: number of the block, from 0.
        episodes: 1 .. block_size; a shorter block is the beginning of the longer one.
        policy: who acts; the random policy of the settings where it is not given.
        first_episode: number of the block's first episode, where blocks before it may be short; else all are whole.
    """
    acting = policy if policy is not None else BlindPolicy(settings.policy, settings.random_policy())
    draws = generator("datagen/objects", settings.seed, block)
    simulation.load(draw_objects(simulation.task, simulation.objects, settings.split, draws))
    first = block * settings.block_size if first_episode is None else first_episode
    return [_collect_episode(simulation, settings, block, first + index, acting) for index in range(episodes)]


def _collect_episode(
    simulation: GraspSimulation, settings: CollectionSettings, block: int, episode_id: int, policy: CollectingPolicy
) -> Episode:
    seed = integer_seed("datagen/episode", settings.seed, episode_id)
    draws = generator("datagen/policy", seed)
    observation = simulation.reset(generator("datagen/scene", seed))
    object_poses = simulation.object_poses()
    images, actions, rewards, poses = [], [], [], []
    terminated, info = False, {}
    while not terminated:
        action = policy.act(observation.image, observation.step, draws, observation.gripper_pose)
        outcome = simulation.step(action, observe_end=False)
        images.append(observation.image)
        poses.append(observation.gripper_pose)
        actions.append(action)
        rewards.append(outcome.reward)
        observation, terminated, info = outcome.observation, outcome.terminated, outcome.info
    return Episode(
        episode_id=episode_id,
        block=block,
        seed=seed,
        object_ids=simulation.object_ids,
        object_poses=object_poses,
        images=np.stack(images),
        actions=np.stack(actions),
        rewards=np.asarray(rewards, dtype=np.float32),
        gripper_poses=np.stack(poses),
        final_pose=info["final_pose"],
        end=info["end"],
        success=info["success"],
        lifted_object=info["lifted_object"],
        policy=policy.name,
        exploration=policy.exploration,
    )
