"""Tasks as Gymnasium environments: `graspq/RegularGrasping-v0`, `graspq/TargetedGrasping-v0`, and any task.

Each environment owns its physics client, so several live in one process.
"""

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import EzPickle

from graspq.common.errors import UserError
from graspq.objects.defaults import default_object_set
from graspq.objects.object_set import ObjectSet
from graspq.sim.episode import GraspSimulation
from graspq.sim.task import EPISODES_PER_BIN, check_split, task_named

_RENDER_SIZE = 256
_SCENE = ("object_ids", "object_poses")


class Grasping(gymnasium.Env[dict[str, Any], np.ndarray], EzPickle):
    """Grasp an object from a bin: any of five (regular), or one of three purple crosses among four others (targeted).

    | | what | shape, range, unit |
    |---|---|---|
    | action | dx, dy, dz, dphi, in units of the limits (0.06 m, 0.06 m, 0.06 m, 0.4 rad) | float32 [4], [-1, 1] |
    | observation `image` | RGB of the fixed camera | uint8 [64, 64, 3] |
    | observation `step` | actions taken so far | 0 .. 15 |
    | reward | 1 at the last step of a successful grasp, else 0 | {0, 1} |
    | terminated | the gripper went below its trigger height, or T = 15 actions were taken | |
    | truncated | never | |

    `reset(seed=s)` fills a new bin as a function of s; `reset()` drops the same objects anew and switches them every 20
    episodes; `reset(options={"scene": row})` lays objects as a row of a dataset's episodes table says. `info` holds
    `gripper_pose` and, at the end, `end`, `success`, `lifted_object` and `final_pose`.

    A copy, also by `pickle`, is a new environment made with the same arguments; it begins with a `reset`.

    Source: Quillen et al. 2018, section IV.
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 12}  # noqa: RUF012  (Gymnasium declares it as an instance variable)

    def __init__(
        self,
        task: str = "regular",
        objects: str | Path | None = None,
        split: str = "train",
        render_mode: str | None = None,
        depth_and_mask: bool = False,
    ) -> None:
        """Make the environment.

        Args:
            task: `regular`, `targeted`, or `module:task` of your own.
            objects: folder of an object set; the project's own set by default.
            split: `train`, `test` or `validation`; the targeted task also has `test-clutter`.
            render_mode: `rgb_array`, `human` (PyBullet's window) or None.
            depth_and_mask: `info` holds `depth` and `mask` of the image, as `graspq.sim.observation` describes them.

        Raises:
            UserError: the task, the folder, the split or the render mode is not as expected.
        """
        EzPickle.__init__(self, task, objects, split, render_mode, depth_and_mask)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise UserError(f"render_mode {render_mode!r}: choose from rgb_array, human or None")
        if sys.platform == "linux" and not os.environ.get("DISPLAY"):
            # What checks an environment tries all its modes.
            self.metadata = {**self.metadata, "render_modes": ["rgb_array"]}
        self.task = task_named(task)
        check_split(self.task, split)
        own = self.task.object_set
        self.objects = ObjectSet.load(Path(objects)) if objects is not None else default_object_set(own)
        self.split, self.render_mode = split, render_mode
        size = self.task.settings.image_size
        self.observation_space = spaces.Dict(
            {
                "image": spaces.Box(0, 255, (size, size, 3), np.uint8),
                "step": spaces.Discrete(self.task.settings.max_steps + 1),
            }
        )
        self.action_space = spaces.Box(-1.0, 1.0, (self.task.action.size,), np.float32)
        self.simulation = GraspSimulation(
            self.task, self.objects, gui=render_mode == "human", depth_and_mask=depth_and_mask
        )
        self._episodes_in_bin = EPISODES_PER_BIN

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode; see the class.

        Args:
            seed: of a new bin.
            options: `scene`: a mapping with `object_ids` (of this environment's object set) and `object_poses`
                ([K, 7]: metres, quaternion xyzw), such as a row of the episodes table; nothing is dropped then.

        Raises:
            UserError: an option is unknown, or the scene is not as expected.
        """
        super().reset(seed=seed)
        scene = _scene(options)
        if scene is not None:
            self.simulation.load(scene[0])
            self.simulation.lay(scene[1])
            self._episodes_in_bin = 1
            return self._observation(), self._info()
        if seed is not None or self._episodes_in_bin >= EPISODES_PER_BIN:
            self.simulation.load(self.task.draw(self.objects, self.split, self.np_random))
            self._episodes_in_bin = 0
        self._episodes_in_bin += 1
        self.simulation.reset(self.np_random)
        return self._observation(), self._info()

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Apply an action; see the class."""
        outcome = self.simulation.step(action)
        return self._observation(), outcome.reward, outcome.terminated, False, self._info() | outcome.info

    def _observation(self) -> dict[str, Any]:
        observation = self.simulation.observation
        return {"image": observation.image.copy(), "step": np.int64(observation.step)}

    def _info(self) -> dict[str, Any]:
        observation = self.simulation.observation
        info = {"gripper_pose": observation.gripper_pose.copy()}
        if observation.depth is not None and observation.mask is not None:
            info |= {"depth": observation.depth.copy(), "mask": observation.mask.copy()}
        return info

    def render(self) -> np.ndarray | None:
        """Return the camera's view, uint8 [256, 256, 3], in `rgb_array` mode; the window draws itself."""
        return self.simulation.render(_RENDER_SIZE) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Free the physics client."""
        self.simulation.close()


def _scene(options: dict[str, Any] | None) -> tuple[list[str], np.ndarray] | None:
    """Return the ids [K] and poses, float [K, 7], of the scene that options ask for."""
    unknown = sorted(set(options or {}) - {"scene"})
    if unknown:
        raise UserError(f"reset: unknown option {unknown[0]!r}; expected 'scene' or none")
    scene = (options or {}).get("scene")
    if scene is None:
        return None
    if not isinstance(scene, Mapping) or not set(_SCENE) <= set(scene):
        raise UserError(f"reset: option 'scene': expected a mapping with {' and '.join(_SCENE)}")
    ids = [str(object_id) for object_id in scene["object_ids"]]
    try:
        poses = np.asarray([np.asarray(pose, dtype=float) for pose in scene["object_poses"]])
    except (TypeError, ValueError):
        poses = np.zeros(0)
    if not ids or poses.shape != (len(ids), 7) or not np.isfinite(poses).all():
        raise UserError(
            f"reset: option 'scene': expected object_poses of {len(ids)} rows of 7 finite numbers, one for each of "
            f"object_ids, got the shape {list(poses.shape)}"
        )
    return ids, poses
