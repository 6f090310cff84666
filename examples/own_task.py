"""A task of your own: three objects, of which only a light one counts, and at most eight actions.

cd examples && grasp-datagen --task own_task:task --size 1000 --out ../data/light
cd examples && grasp-eval --task own_task:task --policy oracle --episodes 200
gymnasium.make("graspq/Grasping-v0", task="own_task:task")
"""

import dataclasses

import numpy as np

from graspq.objects.object_set import ObjectSet
from graspq.sim.task import RegularGrasping, TaskSettings, at_least, check_split


@dataclasses.dataclass(frozen=True)
class LightSettings(TaskSettings):
    """The cell's numbers and one of our own; a dataset's manifest holds them all."""

    objects_per_bin: int = 3
    max_steps: int = 8
    heaviest: float = 0.05  # kilograms that still count as light


@dataclasses.dataclass(frozen=True)
class LightGrasping(RegularGrasping):
    """Lift a light object; a bin holds at least one."""

    settings: LightSettings = LightSettings()

    def wanted(self, objects: ObjectSet, object_id: str) -> bool:
        """Return whether lifting this object is rewarded."""
        return objects[object_id].mass <= self.settings.heaviest

    def draw(self, objects: ObjectSet, split: str, rng: np.random.Generator) -> tuple[str, ...]:
        """Return the ids of the objects in one bin."""
        check_split(self, split)
        ids = at_least(objects, split, self.settings.objects_per_bin)
        light = [object_id for object_id in ids if self.wanted(objects, object_id)]
        first = light[rng.integers(len(light))]
        others = [object_id for object_id in ids if object_id != first]
        return (first, *rng.choice(others, size=self.settings.objects_per_bin - 1, replace=False).tolist())


task = LightGrasping()
