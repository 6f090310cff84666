"""One finished grasp attempt, as the simulator hands it to the shard writer and as the reader gives it back.

Labels are not part of it: they are functions of it, in `labels`. Dimension key: T steps, A parts of an
action, K objects, H W C image.
"""

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

End = Literal["height", "T"]
ENDS: tuple[str, ...] = get_args(End)
Float32 = npt.NDArray[np.float32]
UInt8 = npt.NDArray[np.uint8]
Int64 = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode; its last step alone is terminal.

    Attributes:
        episode_id: number of the episode in its dataset, ≥ 0; consecutive in a dataset.
        block: number of the block it belongs to, ≥ 0.
        seed: the seed of its scene, 0 .. 2⁶³ − 1.
        object_ids: [K] names of the objects in the bin.
        object_poses: float32 [K, 7], (x, y, z, qx, qy, qz, qw) in the world after settling; metres, unit quaternion.
        images: uint8 [T, H, W, 3], RGB seen before each action.
        actions: float32 [T, A], in units of the action limits, in [−1, 1].
        rewards: float32 [T].
        gripper_poses: float32 [T, A], measured before each action, in the units of the action space; angles unwrapped.
        final_pose: float32 [A], measured after the last action and before the scripted descent.
        ended_by: what ended it, `"height"` (the height trigger) or `"T"` (the last allowed step).
        success: whether it counts as a success of the task.
        lifted_object: name of the object that was lifted, or None.
        policy: name of the policy that acted.
        exploration: the policy's own exploration parameter, such as the probability of descending.
        final_image: uint8 [H, W, 3], RGB after the gripper has closed and lifted; None where the data lack it.

    Raises:
        ValueError: a shape, dtype or name is not as stated.
    """

    episode_id: int
    block: int
    seed: int
    object_ids: tuple[str, ...]
    object_poses: Float32
    images: UInt8
    actions: Float32
    rewards: Float32
    gripper_poses: Float32
    final_pose: Float32
    ended_by: End
    success: bool
    lifted_object: str | None
    policy: str
    exploration: float
    final_image: UInt8 | None = None

    def __post_init__(self) -> None:
        steps = len(self.images)
        if steps < 1 or self.images.ndim != 4 or self.images.shape[3] != 3:
            raise ValueError(f"images: expected uint8 [T ≥ 1, H, W, 3], got {self.images.shape}")
        _check("images", self.images, np.uint8, self.images.shape)
        size = self.actions.shape[-1]
        _check("actions", self.actions, np.float32, (steps, size))
        _check("rewards", self.rewards, np.float32, (steps,))
        _check("gripper_poses", self.gripper_poses, np.float32, (steps, size))
        _check("final_pose", self.final_pose, np.float32, (size,))
        _check("object_poses", self.object_poses, np.float32, (len(self.object_ids), 7))
        if self.final_image is not None:
            _check("final_image", self.final_image, np.uint8, self.images.shape[1:])
        if self.ended_by not in ENDS:
            raise ValueError(f"ended_by: expected one of {', '.join(ENDS)}, got {self.ended_by!r}")
        if min(self.episode_id, self.block, self.seed) < 0:
            raise ValueError("episode_id, block and seed are whole numbers of at least 0")

    @property
    def steps(self) -> int:
        """T, the number of actions."""
        return len(self.images)


def _check(name: str, value: Any, dtype: Any, shape: tuple[int, ...]) -> None:
    if value.dtype != dtype or value.shape != shape:
        expected = f"{np.dtype(dtype).name} {list(shape)}"
        raise ValueError(f"{name}: expected {expected}, got {value.dtype} {list(value.shape)}")
    if value.dtype.kind == "f" and not np.isfinite(value).all():
        raise ValueError(f"{name}: expected finite numbers")
