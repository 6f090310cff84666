"""One grasping cell as a simulation: load objects, start episodes, act, observe.

Everything that happens is a function of `load`'s objects and the generators given to the `reset`s since then: `load`
empties the world, so what happened before leaves no trace.
"""

import dataclasses
from collections.abc import Sequence
from types import TracebackType
from typing import Any

import numpy as np
import trimesh

from graspq.objects.object_set import ObjectSet
from graspq.sim import cell, robot_model
from graspq.sim.arm import Arm
from graspq.sim.camera import Camera
from graspq.sim.clearance import Boxes, is_clear
from graspq.sim.observation import ARM, Observation
from graspq.sim.renderer import Part, Renderer, box
from graspq.sim.task import Task
from graspq.sim.world import Body, World

_DESCEND_SPEED = 0.0025  # metres a simulation step
_CLOSE_STEPS = 40
# Pads nearer than this have nothing between them; where the gripper touches no object either, it lifts nothing:
# docs/simulator.md has the gaps of 14,000 grasps. Fingers that met nothing are at 0.1 to 0.2 mm.
_EMPTY_GAP = 0.001  # metres
_CLOSED_AT_FIRST = 32  # simulation steps that fingers need to come together, at least
_CLOSE_CHECK = 2  # simulation steps
_LIFT_STEPS = 84
_HOLD_STEPS = 4  # the last simulation steps of an action, for the arm to come to rest
_SHAPES_KEPT = 256  # so that the memory of a worker does not grow with the number of objects
_FINISHED = "the episode has ended; call reset first"


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What an action led to.

    Attributes:
        observation: after the action; after the last one, of the gripper closed and lifted.
        reward: 1.0 for a successful grasp at the last step, else 0.0.
        terminated: whether the episode has ended.
        info: at the end `ended_by` ("height" or "T"), `success`, `lifted_object` (id or None), `final_pose`
            (float32 [4], after the last action and before the scripted descent); empty before.
    """

    observation: Observation
    reward: float
    terminated: bool
    info: dict[str, Any]


class GraspSimulation:
    """A cell with its own physics client; close it, or use it in a `with` statement."""

    def __init__(self, task: Task, objects: ObjectSet, *, gui: bool = False, depth_and_mask: bool = False) -> None:
        """Make an empty cell.

        Args:
            task: what to do.
            objects: what it is done with.
            gui: open PyBullet's window.
            depth_and_mask: observations have both.
        """
        self.task, self.objects, self.with_depth_and_mask = task, objects, depth_and_mask
        settings = task.settings
        self.renderer = Renderer(
            Camera(), [box(*still) for still in (cell.table_box(settings), *cell.bin_boxes(settings))]
        )
        self._shapes: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self.world = World(time_step=settings.time_step, solver_iterations=settings.solver_iterations, gui=gui)
        self.object_ids: tuple[str, ...] = ()
        self.bodies: list[Body] = []
        self.step_count, self.terminated = 0, True
        self._observation: Observation | None = None

    def load(self, object_ids: Sequence[str]) -> None:
        """Empty the world and build the cell with these objects."""
        self.world.reset()
        # They never move: asked once, not at every action.
        self._fixed = [part.bounds() for part in cell.build_bin(self.world, self.task.settings)]
        self.arm = Arm(self.world, self.task.settings)
        self.object_ids = tuple(object_ids)
        self.bodies = cell.load_objects(self.world, self.task.settings, self.objects, object_ids)
        arm = [Part(link.vertices, link.faces, link.color, ARM) for link in robot_model.visible_links()]
        self.renderer.hold([*arm, *(self._part(object_id, place) for place, object_id in enumerate(object_ids))])
        self.terminated = True

    def _part(self, object_id: str, place: int) -> Part:
        """Return an object as the renderer draws it."""
        if object_id not in self._shapes:
            if len(self._shapes) == _SHAPES_KEPT:
                self._shapes.clear()
            whole = trimesh.util.concatenate(list(self.objects.parts_of(object_id)))
            self._shapes[object_id] = np.asarray(whole.vertices), np.asarray(whole.faces)
        return Part(*self._shapes[object_id], self.objects[object_id].color, place)

    def reset(self, rng: np.random.Generator) -> Observation:
        """Drop the objects anew, home the arm and return the first observation."""
        self.arm.park()
        cell.drop(self.bodies, self.task.settings, rng)
        cell.settle(self.world, self.bodies, self.task.settings)
        return self._started()

    def lay(self, poses: np.ndarray) -> Observation:
        """Lay the objects at rest as `object_poses` recorded them, home the arm and return the first observation.

        Args:
            poses: float [K, 7], position (metres) and quaternion (xyzw) of each loaded object.
        """
        self.arm.park()
        for body, pose in zip(self.bodies, poses, strict=True):
            body.set_pose(pose[:3], pose[3:])
            cell.sleep(body)
        return self._started()

    def _started(self) -> Observation:
        self.arm.place(self.arm.home())
        self.step_count, self.terminated = 0, False
        self._observation = None
        return self.observation

    @property
    def observation(self) -> Observation:
        """The current observation; rendered when first asked for."""
        if self._observation is None:
            size = self.task.settings.image_size
            depth, mask = self.depth_and_mask(size) if self.with_depth_and_mask else (None, None)
            pose = self.arm.pose().astype(np.float32)
            self._observation = Observation(self.render(size), self.step_count, pose, depth, mask)
        return self._observation

    def object_poses(self) -> np.ndarray:
        """Return float32 [K, 7]: position (metres) and quaternion (xyzw) of each object."""
        poses = [[*position, *orientation] for position, orientation in (body.pose() for body in self.bodies)]
        return np.asarray(poses, dtype=np.float32).reshape(len(self.bodies), 7)

    def step(self, action: Sequence[float] | np.ndarray) -> Outcome:
        """Apply one action.

        Args:
            action: [A] in units of the limits of the task's actions, clipped to [-1, 1].

        Raises:
            RuntimeError: the episode has ended.
            ValueError: the action has another shape or is not finite.
        """
        if self.terminated:
            raise RuntimeError(_FINISHED)
        values, settings, space = np.asarray(action, dtype=float), self.task.settings, self.task.action
        if values.shape != (space.size,) or not np.isfinite(values).all():
            raise ValueError(f"an action is {space.size} finite numbers ({', '.join(space.names)}), got {action!r}")
        pose = self.arm.commanded + np.clip(values, -1.0, 1.0) * np.asarray(space.limits)
        commanded = np.clip(pose, *settings.workspace_bounds)
        self._move(commanded, settings.steps_per_action - _HOLD_STEPS, hold=_HOLD_STEPS)
        self.step_count += 1
        self._observation = None
        low = bool(self.arm.commanded[2] < settings.trigger_height)
        if not low and self.step_count < settings.max_steps:
            return Outcome(self.observation, 0.0, False, {})
        self.terminated = True
        final_pose = self.arm.pose().astype(np.float32)
        lifted = self._close_and_lift(descend=low)
        rewarded = self.task.rewarded(self.objects, lifted)
        info = {
            "ended_by": "height" if low else "T",
            "success": rewarded is not None,
            "lifted_object": rewarded if rewarded is not None else next(iter(lifted), None),
            "final_pose": final_pose,
        }
        return Outcome(self.observation, float(rewarded is not None), True, info)

    def _move(self, pose: np.ndarray, steps: int, hold: int) -> None:
        """Move the arm: at once where it meets nothing on its way and all objects rest, else by simulation."""
        if self._is_clear(self.arm.gripper, pose):
            self.arm.carry(pose, steps)
            return
        self.arm.move(pose, steps, hold=hold)
        if cell.at_rest(self.bodies):
            for body in self.bodies:
                cell.sleep(body)

    def _is_clear(self, gripper: Boxes, pose: np.ndarray) -> bool:
        """Return whether all objects rest and boxes of the gripper meet nothing from where it is to a pose."""
        if not cell.at_rest(self.bodies):
            return False
        obstacles = Boxes([*self._fixed, *(body.bounds() for body in self.bodies)])
        return is_clear(gripper, self.arm.commanded.tolist(), pose.tolist(), obstacles)

    def _close_and_lift(self, *, descend: bool) -> list[str]:
        """Close where the gripper is (below the trigger height after a descent to the grasp height), then lift.

        As soon as the gripper is known to hold nothing the rest is not simulated.

        Returns the ids of the lifted objects, highest first.
        """
        pose = self.arm.commanded.copy()
        if descend:
            pose[2] = self.task.settings.grasp_height
            steps = max(4, round((self.arm.commanded[2] - pose[2]) / _DESCEND_SPEED))
            self._move(pose, steps, hold=2)
        holds = self._close()
        pose[2] += self.task.settings.lift_height
        if not (holds and self.arm.move(pose, _LIFT_STEPS, hold=4, is_in_vain=self._is_in_vain)):
            self.arm.carry(pose, _LIFT_STEPS, open_gripper=False)
            return []
        heights = [body.pose()[0][2] for body in self.bodies]
        ranked = sorted(range(len(heights)), key=lambda index: -heights[index])
        return [self.object_ids[index] for index in ranked if heights[index] > self.task.settings.success_height]

    def _close(self) -> bool:
        """Close the gripper; return whether it may hold anything: its pads are apart, or it touches an object.

        Closed fingers may still hook an object: one grasp in ten thousand.
        """
        if self._is_clear(self.arm.between_pads, self.arm.commanded):
            return False
        self.arm.grip(open_gripper=False)
        self.world.step(_CLOSED_AT_FIRST)
        for _ in range(_CLOSED_AT_FIRST, _CLOSE_STEPS, _CLOSE_CHECK):
            if self._is_empty():
                return False
            self.world.step(_CLOSE_CHECK)
        return not self._is_empty()

    def _is_empty(self) -> bool:
        """Return whether the pads are together and nothing touches the gripper."""
        return self.arm.finger_gap() < _EMPTY_GAP and not self.arm.is_touching(self.bodies)

    def _is_in_vain(self) -> bool:
        """Return whether the empty gripper is above all objects, and none of them can be high enough at the end."""
        if not self._is_empty():
            return False
        tip, most = self.arm.tip_height(), self.task.settings.success_height
        return all(body.bounds()[1][2] < tip and body.apex() < most for body in self.bodies)

    def render(self, size: int) -> np.ndarray:
        """Return the camera's view at another resolution, uint8 [size, size, 3]."""
        return self.renderer.image(self._poses(), size)

    def depth_and_mask(self, size: int) -> tuple[np.ndarray, np.ndarray]:
        """Return depth, float32 [size, size], and mask, int32 [size, size]; see `Observation`."""
        return self.renderer.depth_and_mask(self._poses(), size)

    def _poses(self) -> np.ndarray:
        """Return the poses of what the renderer holds, float64 [P, 7]."""
        objects = [position + orientation for position, orientation in (body.pose() for body in self.bodies)]
        return np.array([*self.arm.link_poses(), *objects])

    def close(self) -> None:
        """Free the physics client."""
        self.world.close()

    def __enter__(self) -> "GraspSimulation":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
