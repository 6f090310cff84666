"""Tasks: what lies in the bin, how the gripper may move, what counts as success.

A task's settings and `SIMULATOR_VERSION`, which stands for all that is written in the code of this folder, determine an
episode; a dataset's manifest stores them, so that an evaluation rebuilds the same cell.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, Protocol

import numpy as np

from graspq.common.action_space import ActionSpace, grasping
from graspq.common.errors import UserError
from graspq.common.named_objects import named_object
from graspq.common.options import Settings
from graspq.objects.object_set import ObjectSet

# Raised by hand with every change of this folder that can change a pixel or a pose.
SIMULATOR_VERSION = 2
EPISODES_PER_BIN = 20  # the paper switches the objects every 20 episodes


@dataclasses.dataclass(frozen=True)
class TaskSettings(Settings):
    """A task's numbers and its cell; metres, radians, seconds, kilograms, newtons.

    Attributes:
        name: of the task, `regular`, `targeted` or `module:task`.
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

    name: str = "regular"
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

    def __post_init__(self) -> None:
        """Check all values: settings come from files too.

        Raises:
            UserError: a number is not finite, or far beyond what can be simulated.
        """
        super().__post_init__()
        for field in dataclasses.fields(self):
            value, most = getattr(self, field.name), 4096 if field.name == "image_size" else 1_000_000
            if not isinstance(value, str) and not -most <= value <= most:
                raise UserError(f"task {self.name}: {field.name} = {value}, expected at most {most:,}")

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


class Task(Protocol):
    """What a simulation asks of a task; derive your own from `RegularGrasping`, or write all of it."""

    @property
    def settings(self) -> TaskSettings:
        """Its numbers; a dataset's manifest holds them as JSON."""

    @property
    def splits(self) -> tuple[str, ...]:
        """The splits that its bins can be filled from."""

    @property
    def object_set(self) -> str:
        """Name of the project's own object set that it takes by default, `regular` or `targeted`."""

    @property
    def action(self) -> ActionSpace:
        """What an action means."""

    def with_settings(self, settings: TaskSettings) -> "Task":
        """Return the same task with other numbers."""

    def draw(self, objects: ObjectSet, split: str, rng: np.random.Generator) -> tuple[str, ...]:
        """Return the ids of the objects in one bin.

        Raises:
            UserError: the task has no such split, or the object set too few objects in it.
        """

    def rewarded(self, objects: ObjectSet, lifted: Sequence[str]) -> str | None:
        """Return the lifted object that earns the reward of 1, or None; `lifted` is ordered, highest first."""

    def wanted(self, objects: ObjectSet, object_id: str) -> bool:
        """Return whether lifting this object would be rewarded; the oracle goes for those."""


@dataclasses.dataclass(frozen=True)
class RegularGrasping:
    """Regular grasping: different objects of the split, drawn at random; lifting any of them is a success.

    Source: Quillen et al. 2018, section IV.
    """

    settings: TaskSettings = TaskSettings()
    splits: ClassVar[tuple[str, ...]] = ("train", "test", "validation")
    object_set: ClassVar[str] = "regular"

    @property
    def action(self) -> ActionSpace:
        """Displacements of the gripper in units of the settings' limits."""
        return grasping(self.settings.action_limits)

    def with_settings(self, settings: TaskSettings) -> "RegularGrasping":
        """Return the same task with other numbers."""
        return dataclasses.replace(self, settings=settings)

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Travel to other processes by name where the module of the task is a user's own: they import it."""
        own = ":" in self.settings.name
        return (task_from_json, (self.settings.to_json(),)) if own else super().__reduce_ex__(protocol)

    def draw(self, objects: ObjectSet, split: str, rng: np.random.Generator) -> tuple[str, ...]:
        """Return the ids of `objects_per_bin` different objects of the split; see `Task.draw`."""
        check_split(self, split)
        ids, count = at_least(objects, split, self.settings.objects_per_bin), self.settings.objects_per_bin
        return tuple(ids[index] for index in rng.choice(len(ids), size=count, replace=False))

    def rewarded(self, objects: ObjectSet, lifted: Sequence[str]) -> str | None:
        """Return the highest of the lifted objects that are wanted; lifting another one beside it still counts."""
        return next((object_id for object_id in lifted if self.wanted(objects, object_id)), None)

    def wanted(self, objects: ObjectSet, object_id: str) -> bool:
        """Return True: any object will do."""
        return True


@dataclasses.dataclass(frozen=True)
class TargetedGrasping(RegularGrasping):
    """Targeted grasping in clutter: some copies of one target among other objects; only a lifted target is a success.

    Targets and distractors are the same in every episode, in training and in `test`, whose poses are unseen;
    `test-clutter` and `validation` have unseen distractors, each its own.

    Source: Quillen et al. 2018, section IV.
    """

    settings: TaskSettings = TaskSettings(name="targeted", objects_per_bin=7, targets_per_bin=3)
    splits: ClassVar[tuple[str, ...]] = ("train", "test", "test-clutter", "validation")
    object_set: ClassVar[str] = "targeted"

    def draw(self, objects: ObjectSet, split: str, rng: np.random.Generator) -> tuple[str, ...]:
        """Return the target as often as the settings say, and the distractors; see `Task.draw`."""
        check_split(self, split)
        targets = at_least(objects, "target", 1)
        unseen = {"test-clutter": "test-distractor", "validation": "validation-distractor"}
        count = self.settings.objects_per_bin - self.settings.targets_per_bin
        return (targets[0],) * self.settings.targets_per_bin + at_least(
            objects, unseen.get(split, "distractor"), count
        )[:count]

    def wanted(self, objects: ObjectSet, object_id: str) -> bool:
        """Return whether the object is a target."""
        return objects[object_id].split == "target"


TASKS: dict[str, Task] = {"regular": RegularGrasping(), "targeted": TargetedGrasping()}


def task_named(name: str) -> Task:
    """Return a task by name: `regular`, `targeted`, or `module:task` of your own, from the working folder too.

    A task of your own is an object (or a class or function that makes one without arguments); its settings take
    this name, so that a dataset's manifest leads back to it.

    Raises:
        UserError: there is no such task, or it lacks a part of `Task`.
    """
    if name in TASKS:
        return TASKS[name]
    if ":" not in name:
        raise UserError(f"unknown task {name!r}; choose from {', '.join(TASKS)}, or module:task of your own")
    found = named_object(name, "task")
    if isinstance(found, type) or not hasattr(found, "settings"):
        found = found() if callable(found) else found
    missing = [part for part in _PARTS if not hasattr(found, part)]
    if missing:
        raise UserError(f"task {name}: has no {missing[0]!r}; derive it from graspq.sim.task.RegularGrasping")
    task: Task = found
    return task.with_settings(dataclasses.replace(task.settings, name=name))


_PARTS = ("settings", "splits", "object_set", "action", "with_settings", "draw", "rewarded", "wanted")


def task_from_json(values: dict[str, Any]) -> Task:
    """Return the task that a manifest or a run describes: that of its name, with these settings.

    Args:
        values: `task.settings.to_json()`, as it was when the data were made.

    Raises:
        UserError: there is no such task here, or it was simulated by another version of the simulator.
    """
    if not isinstance(values.get("name"), str):
        raise UserError(f"task {values!r}: expected a name; make the data again")
    task = task_named(values["name"])
    settings = type(task.settings).from_json(values)
    if settings.simulator_version != SIMULATOR_VERSION:
        raise UserError(
            f"task {settings.name}: of simulator version {settings.simulator_version}, this graspq has "
            f"{SIMULATOR_VERSION}; use the graspq that made the data, or make them again"
        )
    return task.with_settings(settings)


def check_split(task: Task, split: str) -> None:
    """Refuse a split that a task's bins cannot be filled from.

    Raises:
        UserError: it is none of `task.splits`.
    """
    if split not in task.splits:
        raise UserError(f"split {split!r}: the {task.settings.name} task has {', '.join(task.splits)}")


def at_least(objects: ObjectSet, split: str, count: int) -> tuple[str, ...]:
    """Return the ids of a split that a task needs `count` objects of.

    Raises:
        UserError: the object set has fewer.
    """
    ids = objects.ids(split)
    if len(ids) < count:
        raise UserError(
            f"object set {objects.name}: {len(ids)} objects in split {split!r}, this task needs at least {count}; "
            "make a set for the task with grasp-objects"
        )
    return ids
