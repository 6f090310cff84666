"""The two tasks as data: what lies in the bin, how the gripper may move, what counts as success.

A task's settings and `SIMULATOR_VERSION`, which stands for all that is written in the code of this folder, determine an
episode; a dataset's manifest stores them, so that an evaluation rebuilds the same cell.
"""

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np

from graspq.common.errors import UserError
from graspq.common.options import Settings
from graspq.objects.object_set import ObjectSet

# Raised by hand with every change of this folder that can change a pixel or a pose.
SIMULATOR_VERSION = 1
EPISODES_PER_BIN = 20  # the paper switches the objects every 20 episodes


@dataclasses.dataclass(frozen=True)
class TaskSettings(Settings):
    """One task and its cell; metres, radians, seconds, kilograms, newtons.

    Attributes:
        name: `regular` rewards any lifted object, `targeted` only a target.
        objects_per_bin: objects in the bin, targets included.
        targets_per_bin: how many of them are targets (0 in the regular task).
        max_steps: T; the gripper closes at the latest after this many actions.
        image_size: height and width of the observation, pixels.
        translation_limit: displacement of an action component of 1 in x, y and z.
        rotation_limit: turn of an action component of 1.
        trigger_height: the gripper closes once its commanded height is below this.
        home_height: height of the gripper at the start, and its greatest height.
        grasp_height: height of the tool centre point when the gripper closes.
        workspace: the commanded gripper stays within ± this of the bin's centre, in x and y.
        phi_limit: the commanded gripper's turn stays within ± this.
        bin_center_x: the bin's centre lies at (bin_center_x, 0).
        bin_half_width: inner half width of the bin.
        wall_height: of the bin.
        drop_half_width: objects are dropped within ± this of the bin's centre.
        success_height: an object whose centre of mass ends above this was lifted.
        lift_height: the gripper rises by this much after closing.
        finger_force: of each finger.
        finger_friction: lateral friction coefficient of the fingers.
        object_friction: lateral friction coefficient of the objects.
        rolling_friction: rolling and spinning friction of objects and fingers, metres.
        time_step: of the simulation.
        solver_iterations: of the constraint solver, a step.
        steps_per_action: simulation steps an action takes.
        settle_steps: most simulation steps objects get to come to rest.
        simulator_version: of the code; settings of another version cannot be simulated.
    """

    name: Literal["regular", "targeted"] = "regular"
    objects_per_bin: int = 5
    targets_per_bin: int = 0
    max_steps: int = 15
    image_size: int = 64
    translation_limit: float = 0.06
    rotation_limit: float = 0.4
    trigger_height: float = 0.05
    home_height: float = 0.28
    grasp_height: float = 0.015
    workspace: float = 0.13
    phi_limit: float = 1.75
    bin_center_x: float = 0.55
    bin_half_width: float = 0.16
    wall_height: float = 0.04
    drop_half_width: float = 0.1
    success_height: float = 0.12
    lift_height: float = 0.21
    finger_force: float = 12.0
    finger_friction: float = 1.2
    object_friction: float = 0.8
    rolling_friction: float = 0.001
    time_step: float = 1 / 240
    solver_iterations: int = 20
    steps_per_action: int = 20
    settle_steps: int = 480
    simulator_version: int = SIMULATOR_VERSION

    @property
    def action_limits(self) -> tuple[float, float, float, float]:
        """Displacement of an action of ones: metres, metres, metres, radians."""
        return (self.translation_limit,) * 3 + (self.rotation_limit,)

    @property
    def workspace_bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Least and greatest pose (x, y, z, phi) that the gripper is commanded to: metres, metres, metres, radians."""
        low = (self.bin_center_x - self.workspace, -self.workspace, self.grasp_height, -self.phi_limit)
        high = (self.bin_center_x + self.workspace, self.workspace, self.home_height, self.phi_limit)
        return low, high


TASKS = {
    "regular": TaskSettings(),
    "targeted": TaskSettings(name="targeted", objects_per_bin=7, targets_per_bin=3),
}


def task_settings(name: str) -> TaskSettings:
    """Return the settings of a task by name.

    Raises:
        UserError: there is no such task.
    """
    if name not in TASKS:
        raise UserError(f"unknown task {name!r}; choose from {', '.join(TASKS)}")
    return TASKS[name]


def splits_of(task: TaskSettings) -> tuple[str, ...]:
    """Return the splits that a task's bins can be filled from."""
    return ("train", "test") if task.name == "regular" else ("train", "test", "test-clutter")


def draw_objects(task: TaskSettings, objects: ObjectSet, split: str, rng: np.random.Generator) -> tuple[str, ...]:
    """Return the ids of the objects in one bin.

    Regular: `objects_per_bin` different objects of the split, drawn at random. Targeted: the same targets and
    distractors in every episode, in training and in `test` (whose poses are unseen); `test-clutter` has four unseen
    distractors.

    Raises:
        UserError: the object set has too few objects in this split.
    """
    if split not in splits_of(task):
        raise UserError(f"split {split!r}: the {task.name} task has {', '.join(splits_of(task))}")
    if task.name == "regular":
        return _sample(objects, split, task.objects_per_bin, rng)
    targets = _need(objects, "target", 1)
    distractors = "test-distractor" if split == "test-clutter" else "distractor"
    count = task.objects_per_bin - task.targets_per_bin
    return (targets[0],) * task.targets_per_bin + _need(objects, distractors, count)[:count]


def _sample(objects: ObjectSet, split: str, count: int, rng: np.random.Generator) -> tuple[str, ...]:
    ids = _need(objects, split, count)
    return tuple(ids[index] for index in rng.choice(len(ids), size=count, replace=False))


def _need(objects: ObjectSet, split: str, count: int) -> tuple[str, ...]:
    ids = objects.ids(split)
    if len(ids) < count:
        raise UserError(
            f"object set {objects.name}: {len(ids)} objects in split {split!r}, this task needs at least {count}; "
            "make a set for the task with grasp-objects"
        )
    return ids


def rewarded_object(task: TaskSettings, objects: ObjectSet, lifted: Sequence[str]) -> str | None:
    """Return the lifted object that earns the reward, or None; lifting another object beside a target still counts."""
    if task.name == "regular":
        return lifted[0] if lifted else None
    return next((object_id for object_id in lifted if objects[object_id].split == "target"), None)
