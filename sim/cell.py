"""The bin on its table and the objects in it: building, dropping, settling, sleeping.

Objects are dropped together from random poses and simulated until they rest; then they sleep until something touches
them, which costs a third of the time of simulating them awake.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from graspq.objects.object_set import ObjectSet
from graspq.sim.bullet import bullet
from graspq.sim.task import TaskSettings
from graspq.sim.world import Body, World

_WALL_THICKNESS = 0.008
_TABLE_BEHIND = 0.04  # metres from the bin's centre back to the table's
_TABLE = (0.38, 0.40, 0.01)  # half of its length, width and thickness, metres
_TABLE_COLOR = (0.62, 0.60, 0.57, 1.0)
_FLOOR_COLOR = (0.80, 0.79, 0.76, 1.0)
_WALL_COLOR = (0.42, 0.47, 0.53, 1.0)
_DROP_SPACING = 0.055  # metres of height between one falling object and the next
_REST_SPEED = 0.012  # metres a second
# While objects fall, nothing is gripped: longer steps and fewer iterations do.
_FALL_TIME_STEP = 1 / 120  # seconds
_FALL_ITERATIONS = 10
_CHECK_EVERY = 10  # steps of a fall
_FALL_AT_LEAST = 50  # steps


class Box(NamedTuple):
    """A box that does not move: half extents and centre in metres, colour RGBA in 0..1."""

    half_extents: tuple[float, float, float]
    position: tuple[float, float, float]
    color: tuple[float, float, float, float]


def bin_boxes(task: TaskSettings) -> list[Box]:
    """Return the floor of the bin (its top is z = 0) and its four walls."""
    x, inner, wall = task.bin_center_x, task.bin_half_width, _WALL_THICKNESS / 2
    height = task.wall_height / 2
    outer = inner + 2 * wall
    boxes = [Box((outer, outer, 0.02), (x, 0, -0.02), _FLOOR_COLOR)]
    for side in (-1, 1):
        boxes.append(Box((wall, outer, height), (x + side * (inner + wall), 0, height), _WALL_COLOR))
    for side in (-1, 1):
        boxes.append(Box((inner, wall, height), (x, side * (inner + wall), height), _WALL_COLOR))
    return boxes


def table_box(task: TaskSettings) -> Box:
    """Return the table, which is there to be seen: nothing collides with it."""
    return Box(_TABLE, (task.bin_center_x - _TABLE_BEHIND, 0, -0.022), _TABLE_COLOR)


def build_bin(world: World, task: TaskSettings) -> list[Body]:
    """Add the table, and the floor of the bin and its walls, which are returned."""
    world.add_picture(*table_box(task))
    parts = [world.add_box(*box) for box in bin_boxes(task)]
    for part in parts:
        part.change_dynamics(lateralFriction=0.8, restitution=0.0)
        # Beside an immovable body that is awake a sleeping object would cost 4 microseconds a step.
        part.change_dynamics(activationState=bullet.ACTIVATION_STATE_SLEEP)
    return parts


def load_objects(world: World, task: TaskSettings, objects: ObjectSet, object_ids: Sequence[str]) -> list[Body]:
    """Load objects, far below the table until they are dropped."""
    bodies = []
    for index, object_id in enumerate(object_ids):
        record = objects[object_id]
        body = world.load_urdf(objects.urdf_of(record.object_id), rigid=True, position=(index * 0.3, 0, -2.0))
        body.change_dynamics(
            lateralFriction=task.object_friction,
            spinningFriction=task.rolling_friction,
            rollingFriction=task.rolling_friction,
            restitution=0.0,
            linearDamping=0.04,
            angularDamping=0.06,
        )
        bodies.append(body)
    return bodies


def drop(bodies: Sequence[Body], task: TaskSettings, rng: np.random.Generator) -> None:
    """Put the objects in the air over the bin, at random places and orientations, in a random order of height."""
    order = rng.permutation(len(bodies))
    places = rng.uniform(-task.drop_half_width, task.drop_half_width, size=(len(bodies), 2))
    quaternions = Rotation.random(len(bodies), rng=rng).as_quat()
    for body, rank, (dx, dy), quaternion in zip(bodies, order, places, quaternions, strict=True):
        wake(body)
        body.set_pose((task.bin_center_x + dx, dy, 0.06 + _DROP_SPACING * rank), quaternion)


def settle(world: World, bodies: Sequence[Body], task: TaskSettings) -> float:
    """Simulate until all objects rest, at most `settle_steps` time steps of the task; put them to sleep.

    Returns the seconds simulated.
    """
    taken, most = 0, round(task.settle_steps * task.time_step / _FALL_TIME_STEP)
    with world.paced(_FALL_TIME_STEP, _FALL_ITERATIONS):
        while taken < most:
            world.step(_CHECK_EVERY)
            taken += _CHECK_EVERY
            if taken >= _FALL_AT_LEAST and at_rest(bodies):
                break
    for body in bodies:
        sleep(body)
    return taken * _FALL_TIME_STEP


def at_rest(bodies: Sequence[Body]) -> bool:
    """Return whether no object moves faster than what counts as rest."""
    return all(body.speed() < _REST_SPEED for body in bodies)


def sleep(body: Body) -> None:
    """Let an object sleep until something touches it."""
    body.change_dynamics(activationState=bullet.ACTIVATION_STATE_SLEEP | bullet.ACTIVATION_STATE_ENABLE_SLEEPING)


def wake(body: Body) -> None:
    """Wake an object and keep it awake."""
    body.change_dynamics(activationState=bullet.ACTIVATION_STATE_WAKE_UP | bullet.ACTIVATION_STATE_DISABLE_SLEEPING)
