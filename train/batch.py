"""Batches as tensors on the training device, in one shape for both views: a transition is an episode of T = 1.

Dimensions: B batch, T steps, A action, H W C image.
"""

import dataclasses
import functools
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from graspq.datasets.samples import EpisodeBatch, TransitionBatch

# Where a sample comes from; no estimator asks.
SOURCES = ("episode_id", "block")


@dataclasses.dataclass(frozen=True, eq=False)
class Batch:
    """B transitions (T = 1) or B whole episodes padded to T steps.

    Attributes:
        image: uint8 [B, T, H, W, C], RGB before the action.
        step: int64 [B, T].
        action: float32 [B, T, A], in units of the action limits.
        reward: float32 [B, T].
        terminal: bool [B, T].
        mc_return: float32 [B, T], with the run's discount.
        synthetic_action: float32 [B, T, A], in the units of `action`.
        next_image: uint8 [B, T, H, W, C], meaningless where terminal; None in episodes and where no target reads it.
        next_step: int64 [B, T]; None as `next_image`.
        mask: bool [B, T], false on padding; None where there is none.
        weight: float32 [B, T], of each step in the mean loss; None where all weigh the same.
        more: the pose before the action, `gripper_pose`, and columns of one's own, [B, T, ...] as stored: augmentation
            leaves them alone.
    """

    image: Tensor
    step: Tensor
    action: Tensor
    reward: Tensor
    terminal: Tensor
    mc_return: Tensor
    synthetic_action: Tensor
    next_image: Tensor | None = None
    next_step: Tensor | None = None
    mask: Tensor | None = None
    weight: Tensor | None = None
    more: dict[str, Tensor] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(cls, tensors: Mapping[str, Tensor]) -> "Batch":
        """Return the batch of tensors by name; those without an attribute are `more`."""
        named = {field.name for field in dataclasses.fields(cls)}
        more = {name: tensor for name, tensor in tensors.items() if name not in named}
        return cls(**{name: tensor for name, tensor in tensors.items() if name in named}, more=more)

    @property
    def real_steps(self) -> Tensor:
        """Number of steps that are no padding, a scalar."""
        return torch.tensor(self.step.numel(), device=self.step.device) if self.mask is None else self.mask.sum()

    @functools.cached_property
    def later_steps(self) -> Tensor:
        """Which steps are real and not the first of their episode; bool [B, T]."""
        later = torch.ones_like(self.terminal) if self.mask is None else self.mask.clone()
        later[:, 0] = False
        return later

    @property
    def next_states(self) -> tuple[Tensor, Tensor]:
        """Images uint8 [n, H, W, C] and steps int64 [n] of the s' that there are: none after a last step.

        A ValueError where the loader left them out. What networks say of them is put in its place by `before`.
        """
        if self.next_image is None or self.next_step is None:
            raise ValueError("no s' in this batch: a target that reads it says so by TargetValue(..., needs_next=True)")
        goes_on = ~self.terminal.flatten()
        return self.next_image.flatten(0, 1)[goes_on], self.next_step.flatten()[goes_on]

    def before(self, values: Tensor) -> Tensor:
        """Return values of `next_states`, float [n] or [n, 1], at the steps before them in [B, T]; 0 at last steps."""
        return torch.zeros_like(self.reward).masked_scatter(~self.terminal, values.to(self.reward))

    def real(self, values: Tensor) -> Tensor:
        """Return the entries of [B, T, ...] that are no padding as [n, ...]: the states that a network sees."""
        flat = values.flatten(0, 1)
        return flat if self.mask is None else flat[self.mask.flatten()]

    def mean(self, values: Tensor) -> Tensor:
        """Return the mean of values of the real steps, float [n], by their weights; a scalar."""
        if self.weight is None:
            return values.mean()
        weight = self.real(self.weight)
        return (weight * values).sum() / weight.sum()

    def in_place(self, values: Tensor) -> Tensor:
        """Return values of the real steps, float [n] or [n, 1], where these stand in [B, T]; 0 on padding."""
        if self.mask is None:
            return values.view_as(self.reward)
        return torch.zeros_like(self.reward).masked_scatter(self.mask, values)


def to_tensors(batch: TransitionBatch | EpisodeBatch, device: torch.device) -> Batch:
    """Move a loader's batch to `device`: on the CPU without copying, to a GPU without waiting for the copy.

    Episodes are cut to the longest one of the batch: few last as long as they may.
    """
    transitions = isinstance(batch, TransitionBatch)
    longest = 0 if isinstance(batch, TransitionBatch) else int(batch.mask.any(0).sum())

    def tensor(array: np.ndarray) -> Tensor:
        values = torch.from_numpy(array if transitions else array[:, :longest])
        moved = (values.pin_memory() if device.type == "cuda" else values).to(device, non_blocking=True)
        return moved.unsqueeze(1) if transitions else moved

    arrays = {name: array for name, array in batch.arrays().items() if name not in SOURCES}
    if "next_image" not in arrays:
        arrays.pop("next_step", None)
    return Batch.of({name: tensor(array) for name, array in arrays.items()})
