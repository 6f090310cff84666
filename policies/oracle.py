"""A scripted policy that knows poses and meshes: it shows the ceiling of the task.

It looks for the narrowest reachable grasp clear of neighbours, moves over it, turns, and goes straight down.
Frames: w runs along the pads, c along the closing direction, both horizontal; z is up.
"""

import dataclasses
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from graspq.objects.object_set import ObjectSet
from graspq.sim.episode import GraspSimulation
from graspq.sim.observation import Observation

_YAWS = np.linspace(-np.pi / 2, np.pi / 2, 24, endpoint=False)
_OFFSETS = np.linspace(-0.024, 0.024, 7)  # along the pads, from the centre of mass, metres
_PAD_HALF_WIDTH = 0.011
_PAD_REACH = (0.013, 0.064)  # heights between which the pads touch, at the grasp height
_FINGER_INNER, _FINGER_OUTER = 0.0385, 0.0575  # where the open fingers stand, from the grasp's centre along c
_FINGER_HALF_WIDTH = 0.0135
_WIDEST = 0.074
_SPACING = 0.004  # metres between the points that stand for a surface


@dataclasses.dataclass(frozen=True)
class Grasp:
    """A vertical grasp: centre (metres), turn of the gripper (radians), width between the pads (metres), cost."""

    x: float
    y: float
    phi: float
    width: float
    cost: float


class Oracle:
    """Plans when an episode begins, then follows the plan; its action needs the simulation, not the image."""

    name, exploration = "oracle", 0.0

    def __init__(self) -> None:
        self._surfaces: dict[tuple[str, str], np.ndarray] = {}

    def begin(self, simulation: GraspSimulation) -> None:
        """Look at the scene and plan."""
        self._simulation, self._plan = simulation, self.plan(simulation)

    def act(self, observation: Observation, rng: np.random.Generator) -> np.ndarray:
        """Return the next action, float32 [4]."""
        settings = self._simulation.task.settings
        x, y, _, phi = self._simulation.arm.commanded
        goal = self._plan or Grasp(settings.bin_center_x, 0.0, 0.0, 0.0, 0.0)
        limits = np.asarray(settings.action_limits)
        action: np.ndarray = np.array([goal.x - x, goal.y - y, 0.0, goal.phi - phi]) / limits
        if np.abs(action).max() <= 1.0:
            action[2] = -1.0
        else:
            # Straight to the goal: all components arrive together.
            action = action / np.abs(action).max()
        return action.astype(np.float32)

    def identity(self) -> dict[str, Any]:
        """Return what tells it from others: there is one oracle."""
        return {}

    def plan(self, simulation: GraspSimulation) -> Grasp | None:
        """Return the best grasp of the scene as it lies, or None where no candidate is free."""
        objects = simulation.objects
        clouds = [
            self._surface(objects, object_id) @ Rotation.from_quat(pose[3:]).as_matrix().T + pose[:3]
            for object_id, pose in zip(simulation.object_ids, simulation.object_poses().astype(float), strict=True)
        ]
        wanted = [
            index for index, object_id in enumerate(simulation.object_ids) if simulation.task.wanted(objects, object_id)
        ]
        grasps = [grasp for index in wanted for grasp in self._grasps(simulation, clouds, index)]
        return min(grasps, key=lambda grasp: grasp.cost, default=None)

    def _surface(self, objects: ObjectSet, object_id: str) -> np.ndarray:
        key = (str(objects.folder), object_id)
        if key not in self._surfaces:
            parts = [_surface_points(part) for part in objects.parts_of(object_id)]
            self._surfaces[key] = np.concatenate(parts)
        points: np.ndarray = self._surfaces[key]
        return points

    def _grasps(self, simulation: GraspSimulation, clouds: list[np.ndarray], index: int) -> list[Grasp]:
        settings = simulation.task.settings
        own = clouds[index]
        others = np.concatenate([cloud for k, cloud in enumerate(clouds) if k != index] or [np.zeros((0, 3))])
        center = simulation.bodies[index].pose()[0]
        own = own[own[:, 2] > 0.008] - [center[0], center[1], 0.0]
        others = others[others[:, 2] > 0.008] - [center[0], center[1], 0.0]
        others = others[np.abs(others[:, :2]).max(axis=1) < 0.12]
        found = []
        for phi in _YAWS:
            w = np.array([np.cos(phi), np.sin(phi)])
            c = np.array([-np.sin(phi), np.cos(phi)])
            for offset in _OFFSETS:
                grasp = _candidate(own, others, w, c, offset)
                if grasp is None:
                    continue
                along_c, width, cost = grasp
                x, y = center[:2] + offset * w + along_c * c
                if max(abs(x - settings.bin_center_x), abs(y)) > settings.workspace:
                    continue
                if not _clear_of_walls(settings.bin_half_width, x - settings.bin_center_x, y, c):
                    continue
                found.append(Grasp(float(x), float(y), float(phi), width, cost))
        return found


def _candidate(
    own: np.ndarray, others: np.ndarray, w: np.ndarray, c: np.ndarray, offset: float
) -> tuple[float, float, float] | None:
    """Return (centre along c, width, cost) of a grasp of the points `own`, or None if it cannot work."""
    own_w, own_c = own[:, :2] @ w - offset, own[:, :2] @ c
    pads = (np.abs(own_w) < _PAD_HALF_WIDTH) & (own[:, 2] > _PAD_REACH[0]) & (own[:, 2] < _PAD_REACH[1])
    if pads.sum() < 8:
        return None
    low, high = own_c[pads].min(), own_c[pads].max()
    width, middle = high - low, (low + high) / 2
    if width > _WIDEST or abs(middle) > 0.04:
        return None
    if _hits(own_w, own_c - middle):
        return None
    other_w, other_c = others[:, :2] @ w - offset, others[:, :2] @ c - middle
    if _hits(other_w, other_c):
        return None
    # A neighbour between the pads would be squeezed along; the palm must not come down on one taller than the pads.
    between = (np.abs(other_w) < _FINGER_HALF_WIDTH) & (np.abs(other_c) < _FINGER_INNER)
    tall = np.concatenate([own[:, 2], others[(np.abs(other_w) < 0.03) & (np.abs(other_c) < 0.1), 2]]).max()
    height = own[pads, 2].max()
    slant = abs(own_c[pads & (own[:, 2] < 0.03)].mean() - middle) if (pads & (own[:, 2] < 0.03)).any() else 0.02
    cost = width + 1.5 * abs(offset) + 0.8 * abs(middle) + 0.5 * slant + 0.02 * bool(between.any())
    cost += 0.05 * (tall > 0.11) + 1.0 * max(0.0, 0.024 - height)
    return float(middle), float(width), float(cost)


def _hits(along_w: np.ndarray, along_c: np.ndarray) -> bool:
    """Whether any point lies where an open finger comes down."""
    beside = np.abs(along_c)
    inside = (np.abs(along_w) < _FINGER_HALF_WIDTH) & (beside > _FINGER_INNER) & (beside < _FINGER_OUTER)
    return bool(inside.any())


def _clear_of_walls(half_width: float, x: float, y: float, c: np.ndarray) -> bool:
    """Whether both open fingers, at (x, y) from the bin's centre, stay off its walls."""
    for side in (-1, 1):
        finger = np.array([x, y]) + side * _FINGER_OUTER * c
        if np.abs(finger).max() > half_width - 0.012:
            return False
    return True


def _surface_points(part: trimesh.Trimesh) -> np.ndarray:
    """Return points [P, 3] that cover a part's surface at about `_SPACING`, by subdividing its triangles evenly."""
    points = []
    for triangle in part.triangles:
        longest = max(np.linalg.norm(triangle - np.roll(triangle, 1, axis=0), axis=1))
        count = max(1, int(np.ceil(longest / _SPACING)))
        grid = [(i, j) for i in range(count + 1) for j in range(count + 1 - i)]
        weights = np.array([(i, j, count - i - j) for i, j in grid]) / count
        points.append(weights @ triangle)
    return np.unique(np.concatenate(points).round(5), axis=0)
