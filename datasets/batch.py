"""Batches as the learner sees them: transitions (s, a, r, s′) and whole episodes padded to T with a mask.

A state is the image and `step`. Dimension key: B batch, T steps, A = 4 action, H W C image.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from graspq.datasets.episode import Float32, UInt8

Int64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

# One record holds all columns of a step but its image: a sample is then two copies, image and record.
RECORD = np.dtype(
    [
        ("action", np.float32, (4,)),
        ("synthetic_action", np.float32, (4,)),
        ("reward", np.float32),
        ("mc_return", np.float32),
        ("step", np.int64),
        ("episode_id", np.int64),
        ("block", np.int64),
        ("terminal", np.bool_),
    ]
)
Records = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class TransitionBatch:
    """B transitions.

    Attributes:
        image: uint8 [B, H, W, C], RGB before the action.
        step: int64 [B], 0 .. T − 1.
        action: float32 [B, 4], (dx, dy, dz, dφ) in units of the action limits, in [−1, 1].
        reward: float32 [B].
        terminal: bool [B]; where it is true there is no s′.
        next_image: uint8 [B, H, W, C], RGB after the action; its own image where terminal. None where not asked for.
        next_step: int64 [B], step + 1; its own step where terminal.
        mc_return: float32 [B], see `labels.mc_return`; with the pool's discount.
        synthetic_action: float32 [B, 4], see `labels.synthetic_action`; in the units of `action`.
        episode_id: int64 [B].
        block: int64 [B].
    """

    image: UInt8
    step: Int64
    action: Float32
    reward: Float32
    terminal: Bool
    next_image: UInt8 | None
    next_step: Int64
    mc_return: Float32
    synthetic_action: Float32
    episode_id: Int64
    block: Int64

    @property
    def last(self) -> Bool:
        """bool [B], whether this is the last step of its episode; the same as `terminal`."""
        return self.terminal

    def __len__(self) -> int:
        return len(self.step)


@dataclass(frozen=True, eq=False)
class EpisodeBatch:
    """B whole episodes, each padded to T steps with zeros; `mask` is true on real steps.

    Attributes:
        image: uint8 [B, T, H, W, C].
        step: int64 [B, T]; 0 .. T − 1 everywhere, on padding too.
        action: float32 [B, T, 4], in units of the action limits.
        reward: float32 [B, T].
        terminal: bool [B, T], true on the last real step alone.
        mc_return: float32 [B, T].
        synthetic_action: float32 [B, T, 4].
        episode_id: int64 [B, T], on padding too.
        block: int64 [B, T], on padding too.
        mask: bool [B, T].
    """

    image: UInt8
    step: Int64
    action: Float32
    reward: Float32
    terminal: Bool
    mc_return: Float32
    synthetic_action: Float32
    episode_id: Int64
    block: Int64
    mask: Bool

    @property
    def last(self) -> Bool:
        """bool [B, T], whether this is the last step of its episode; the same as `terminal`."""
        return self.terminal

    def __len__(self) -> int:
        return len(self.step)


def transition_batch(image: UInt8, next_image: UInt8 | None, records: Records) -> TransitionBatch:
    """Return the batch of B gathered records and images; `records` is RECORD [B]."""
    columns = {name: np.ascontiguousarray(records[name]) for name in RECORD.names or ()}
    next_step = columns["step"] + ~columns["terminal"]
    return TransitionBatch(image=image, next_image=next_image, next_step=next_step, **columns)


def episode_batch(image: UInt8, records: Records, mask: Bool) -> EpisodeBatch:
    """Return the batch of B gathered, padded episodes; `records` is RECORD [B, T]."""
    columns = {name: np.ascontiguousarray(records[name]) for name in RECORD.names or ()}
    columns["step"][:] = np.arange(mask.shape[1])
    for name in ("episode_id", "block"):
        columns[name][:] = columns[name][:, :1]
    return EpisodeBatch(image=image, mask=mask, **columns)
