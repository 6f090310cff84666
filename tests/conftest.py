"""Real, small object sets and datasets that the tests of several folders share."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import settings

from graspq.objects.object_set import ObjectSet
from graspq.objects.procedural import make_procedural
from graspq.objects.targeted import make_targeted

# Machines that others share are slow now and then; an example's time says nothing about the code.
settings.register_profile("shared-machine", deadline=None)
settings.load_profile("shared-machine")


@pytest.fixture(scope="session")
def regular_objects(tmp_path_factory: pytest.TempPathFactory) -> ObjectSet:
    """Thirty training, ten test and ten validation objects of the project's own generator."""
    folder = tmp_path_factory.mktemp("objects") / "regular"
    return make_procedural(folder, seed=0, train=30, test=10, validation=10)


@pytest.fixture(scope="session")
def targeted_objects(tmp_path_factory: pytest.TempPathFactory) -> ObjectSet:
    """The set of the targeted task."""
    return make_targeted(tmp_path_factory.mktemp("objects") / "targeted", seed=0)


@pytest.fixture(scope="session")
def collect_regular() -> Callable[[Path, ObjectSet, int, int], Path]:
    """Return what collects blocks of the random policy's grasps as grasp-datagen does, object set beside them."""

    def collect(folder: Path, objects: ObjectSet, blocks: int, block_size: int) -> Path:
        # Here, and not above: most tests need no simulator.
        from graspq.datagen.collect import collect_block
        from graspq.datagen.settings import CollectionSettings
        from graspq.datasets.manifest import Manifest
        from graspq.datasets.writer import commit_shard, write_shard
        from graspq.sim.episode import GraspSimulation
        from graspq.sim.task import TASKS

        task, settings = TASKS["regular"], replace(CollectionSettings(), block_size=block_size)
        manifest = Manifest(
            task=task.settings.to_json(),
            settings=settings.described(),
            versions={},
            object_set={"name": objects.name, "sha256": objects.digest()},
            image_shape=(task.settings.image_size, task.settings.image_size, 3),
            action=task.action,
            discount=1.0,
            phi_range=(-task.settings.phi_limit, task.settings.phi_limit),
        )
        objects.copy_to(folder / "objects")
        with GraspSimulation(task, objects) as simulation:
            collected = [collect_block(simulation, settings, block, block_size) for block in range(blocks)]
        episodes = [episode for block in collected for episode in block]
        manifest.save(folder)
        commit_shard(folder, manifest, write_shard(folder, manifest, 0, blocks, episodes))
        return folder

    return collect
