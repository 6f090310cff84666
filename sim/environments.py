"""The two tasks as Gymnasium environments: `graspq/RegularGrasping-v0` and `graspq/TargetedGrasping-v0`.

Each environment owns its physics client, so several live in one process.
"""

from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

from graspq.common.errors import UserError
from graspq.objects.defaults import default_object_set
from graspq.objects.object_set import ObjectSet
from graspq.sim.episode import GraspSimulation
from graspq.sim.task import EPISODES_PER_BIN, TASKS, check_split

_RENDER_SIZE = 256


class _Grasping(gymnasium.Env[dict[str, Any], np.ndarray]):
    """Grasp an object from a bin.

    | | what | shape, range, unit |
    |---|---|---|
    | action | dx, dy, dz, dphi, in units of the limits (0.06 m, 0.06 m, 0.06 m, 0.4 rad) | float32 [4], [-1, 1] |
    | observation `image` | RGB of the fixed camera | uint8 [64, 64, 3] |
    | observation `step` | actions taken so far | 0 .. 15 |
    | reward | 1 at the last step of a successful grasp, else 0 | {0, 1} |
    | terminated | the gripper went below its trigger height, or T = 15 actions were taken | |
    | truncated | never | |

    `reset(seed=s)` fills a new bin as a function of s; `reset()` drops the same objects anew and switches them every 20
    episodes. `info` holds `gripper_pose` and, at the end, `end`, `success` and `lifted_object`.

    Source: Quillen et al. 2018, section IV.
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 12}  # noqa: RUF012  (Gymnasium declares it as an instance variable)
    task_name: ClassVar[str]

    def __init__(self, objects: str | Path | None = None, split: str = "train", render_mode: str | None = None) -> None:
        """Make the environment.

        Args:
            objects: folder of an object set; the project's own set by default.
            split: `train` or `test`; the targeted task also has `test-clutter`.
            render_mode: `rgb_array`, `human` (PyBullet's window) or None.

        Raises:
            UserError: the folder, the split or the render mode is not as expected.
        """
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise UserError(f"render_mode {render_mode!r}: choose from rgb_array, human or None")
        self.task = TASKS[self.task_name]
        check_split(self.task, split)
        self.objects = ObjectSet.load(objects) if objects is not None else default_object_set(self.task.object_set)
        self.split, self.render_mode = split, render_mode
        size = self.task.settings.image_size
        self.observation_space = spaces.Dict(
            {
                "image": spaces.Box(0, 255, (size, size, 3), np.uint8),
                "step": spaces.Discrete(self.task.settings.max_steps + 1),
            }
        )
        self.action_space = spaces.Box(-1.0, 1.0, (self.task.action.size,), np.float32)
        self.simulation = GraspSimulation(self.task, self.objects, gui=render_mode == "human")
        self._episodes_in_bin = EPISODES_PER_BIN

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode; see the class. `options` takes nothing."""
        super().reset(seed=seed)
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
        return {"gripper_pose": self.simulation.observation.gripper_pose.copy()}

    def render(self) -> np.ndarray | None:
        """Return the camera's view, uint8 [256, 256, 3], in `rgb_array` mode; the window draws itself."""
        return self.simulation.render(_RENDER_SIZE) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Free the physics client."""
        self.simulation.close()


class RegularGrasping(_Grasping):
    """Regular grasping: five objects in the bin, any lifted object is a success."""

    __doc__ = f"{__doc__}\n\n    {_Grasping.__doc__}"
    task_name = "regular"


class TargetedGrasping(_Grasping):
    """Targeted grasping in clutter: three purple crosses among four other objects; only a lifted cross is a success."""

    __doc__ = f"{__doc__}\n\n    {_Grasping.__doc__}"
    task_name = "targeted"
