"""One block of episodes as a pure function of the dataset's settings and the block's number: the engine's unit.

A block is 20 episodes that share their objects; it starts from an emptied world, so it gives the same bytes alone,
after any other blocks, and in any process.
"""

import contextlib
import dataclasses
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from graspq.common.machine import one_thread
from graspq.common.seeding import generator, integer_seed
from graspq.datagen.settings import CollectionSettings
from graspq.datasets.episode import Episode
from graspq.engine import EngineSettings, Place, run
from graspq.objects.object_set import ObjectSet
from graspq.sim.episode import GraspSimulation
from graspq.sim.play import Policy, play
from graspq.sim.task import task_from_json

BLOCKS_PER_WORKER = 500  # the simulator leaks shapes; see RESULTS.md for how much


@dataclasses.dataclass(frozen=True)
class Block:
    """A block to collect.

    Attributes:
        number: from 0; it determines the objects.
        episodes: how many, 1 .. block_size; a shorter block is the beginning of the longer one.
        first_episode: number of its first episode, which determines the scene.
    """

    number: int
    episodes: int
    first_episode: int

    def __str__(self) -> str:
        return f"block {self.number}"


@dataclasses.dataclass(frozen=True)
class Collection:
    """How blocks are collected; the `Work` of a collection.

    Attributes:
        task: settings of the task, as in a manifest.
        objects: folder of the object set.
        settings: what determines the episodes.
        policy: who acts, pickled to each worker; the random policy of the settings where it is None.
    """

    task: dict[str, Any]
    objects: Path
    settings: CollectionSettings
    policy: Policy | None = None

    def folders(self) -> Sequence[Path]:
        """Return the object set's folder."""
        return [self.objects]

    @contextlib.contextmanager
    def open(self, place: Place) -> Iterator[Callable[[Block], list[Episode]]]:
        """Hold one simulation."""
        task, objects = task_from_json(self.task), ObjectSet.load(place(self.objects))
        with one_thread(), GraspSimulation(task, objects) as simulation:
            yield lambda block: collect_block(
                simulation, self.settings, block.number, block.episodes, self.policy, block.first_episode
            )


def collected(
    collection: Collection, blocks: Iterable[Block], engine: EngineSettings
) -> Generator[tuple[Block, list[Episode]], None, None]:
    """Yield each block with its episodes, in any order; see `graspq.engine.run`."""
    modules = [__name__] if collection.policy is None else [__name__, "graspq.policies.of_run"]
    return run(collection, blocks, engine, units_per_worker=BLOCKS_PER_WORKER, modules=modules)


def collect_block(
    simulation: GraspSimulation,
    settings: CollectionSettings,
    block: int,
    episodes: int,
    policy: Policy | None = None,
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
    acting = policy if policy is not None else settings.random_policy()
    draws = generator("datagen/objects", settings.seed, block)
    simulation.load(simulation.task.draw(simulation.objects, settings.split, draws))
    first = block * settings.block_size if first_episode is None else first_episode
    return [_collect_episode(simulation, settings, block, first + index, acting) for index in range(episodes)]


def _collect_episode(
    simulation: GraspSimulation, settings: CollectionSettings, block: int, episode_id: int, policy: Policy
) -> Episode:
    seed = integer_seed("datagen/episode", settings.seed, episode_id)
    simulation.reset(generator("datagen/scene", seed))
    played = play(simulation, policy, generator("datagen/policy", seed))
    return Episode(
        episode_id=episode_id,
        block=block,
        seed=seed,
        object_ids=simulation.object_ids,
        object_poses=played.object_poses,
        images=np.stack([observation.image for observation in played.observations]),
        actions=played.actions,
        rewards=played.rewards,
        gripper_poses=np.stack([observation.gripper_pose for observation in played.observations]),
        final_pose=played.final_pose,
        ended_by=played.ended_by,
        success=played.success,
        lifted_object=played.lifted_object,
        policy=policy.name,
        exploration=policy.exploration,
        final_image=played.last,
    )
