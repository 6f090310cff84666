"""Batches as the learner sees them: transitions (s, a, r, s′) and whole episodes padded to T with a mask.

They are gathered from blocks in memory: the only copy between the Parquet reader and the learner. A state is the image
and `step`. Dimension key: B batch, T steps, A action, H W C image.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from graspq.datasets.blocks import BlockArrays, Records, opaque
from graspq.datasets.columns import batch_columns
from graspq.datasets.episode import Float32, Int64, UInt8

if TYPE_CHECKING:
    import torch

Bool = npt.NDArray[np.bool_]
Blocks = Mapping[int, BlockArrays]


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Samples:
    """What transitions and episodes have in common; N stands for B of transitions and for B, T of episodes.

    All arrays are writeable and contiguous: `torch.from_numpy` takes each without a copy.

    Attributes:
        image: uint8 [N, H, W, C], RGB before the action.
        step: int64 [N], 0 .. T − 1.
        action: float32 [N, A], in units of the action limits, in [−1, 1].
        reward: float32 [N].
        terminal: bool [N], whether this is the last step of its episode.
        gripper_pose: float32 [N, A], before the action, in the units that the action space names.
        mc_return: float32 [N], see `labels.mc_return`; with the pool's discount.
        synthetic_action: float32 [N, A], see `labels.synthetic_action`; in the units of `action`.
        episode_id: int64 [N].
        block: int64 [N].
        more: columns of the table in `columns` that have no attribute here, name → [N, ...].
    """

    image: UInt8
    step: Int64
    action: Float32
    reward: Float32
    terminal: Bool
    gripper_pose: Float32
    mc_return: Float32
    synthetic_action: Float32
    episode_id: Int64
    block: Int64
    more: dict[str, npt.NDArray[Any]] = dataclasses.field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.step)

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return all arrays by name, those of `more` among them; what was not asked for is left out."""
        named = {field.name: getattr(self, field.name) for field in dataclasses.fields(self) if field.name != "more"}
        return {name: array for name, array in named.items() if array is not None} | self.more

    def tensors(self, device: "torch.device | str" = "cpu") -> dict[str, "torch.Tensor"]:
        """Return all arrays as tensors by name: without a copy on the CPU, from pinned memory to a GPU."""
        import torch

        tensors = {name: torch.from_numpy(array) for name, array in self.arrays().items()}
        if torch.device(device).type == "cuda":
            tensors = {name: tensor.pin_memory() for name, tensor in tensors.items()}
        return {name: tensor.to(device, non_blocking=True) for name, tensor in tensors.items()}


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class TransitionBatch(Samples):
    """B transitions; see `Samples`.

    Attributes:
        next_image: uint8 [B, H, W, C], RGB after the action; its own image where terminal. None where not asked for.
        next_step: int64 [B], step + 1; its own step where terminal, for there is no s′.
    """

    next_image: UInt8 | None
    next_step: Int64


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class EpisodeBatch(Samples):
    """B whole episodes; see `Samples`. Each is padded to T steps with zeros.

    `step` is 0 .. T − 1 everywhere, and `episode_id` and `block` are the episode's, on padding too.

    Attributes:
        mask: bool [B, T], true on real steps.
    """

    mask: Bool


NAMED = {field.name for field in dataclasses.fields(Samples)}


def gather_transitions(
    blocks: Blocks, owners: Sequence[int], numbers: Sequence[int], *, need_next: bool
) -> TransitionBatch:
    """Return the batch of item `numbers[i]` of block `owners[i]`, for all i; see `BlockArrays.row_of`."""
    shape = blocks[owners[0]].images.shape[1:]
    image = _room((len(numbers), *shape))
    next_image = _room((len(numbers), *shape)) if need_next else None
    records = np.empty(len(numbers), blocks[owners[0]].records.dtype)
    copied = opaque(records)
    for index, (owner, number) in enumerate(zip(owners, numbers, strict=True)):
        block = blocks[owner]
        row = block.row_of(number)
        image[index] = block.images[row]
        if next_image is not None:
            next_image[index] = block.images[block.next_rows[row]]
        copied[index] = block.opaque[row]
    columns = _columns(records)
    next_step = columns["step"] + ~columns["terminal"]
    return TransitionBatch(image=image, next_image=next_image, next_step=next_step, **columns)


def gather_episodes(blocks: Blocks, owners: Sequence[int], numbers: Sequence[int], *, max_steps: int) -> EpisodeBatch:
    """Return the batch of episode `numbers[i]` of block `owners[i]`, for all i, padded to `max_steps`.

    Raises:
        ValueError: an episode is longer.
    """
    shape = blocks[owners[0]].images.shape[1:]
    image = _room((len(numbers), max_steps, *shape))
    records = np.zeros((len(numbers), max_steps), blocks[owners[0]].records.dtype)
    copied = opaque(records)
    mask = np.zeros((len(numbers), max_steps), np.bool_)
    for index, (owner, number) in enumerate(zip(owners, numbers, strict=True)):
        block = blocks[owner]
        first, length = int(block.first_rows[number]), int(block.lengths[number])
        if length > max_steps:
            raise ValueError(f"max_steps: expected at least {length}, the length of an episode, got {max_steps}")
        image[index, :length] = block.images[first : first + length]
        image[index, length:] = 0
        copied[index, :length] = block.opaque[first : first + length]
        mask[index, :length] = True
    columns = _columns(records)
    columns["step"][:] = np.arange(max_steps)
    for name in ("episode_id", "block"):
        columns[name][:] = columns[name][:, :1]
    return EpisodeBatch(image=image, mask=mask, **columns)


def _columns(records: Records) -> dict[str, Any]:
    """Return the columns of gathered records as arguments of a batch."""
    # Copied, also of one record, which numpy calls contiguous as it is: torch refuses the steps between its fields.
    columns = {name: records[name].copy() for name in batch_columns()}
    more = {name: column for name, column in columns.items() if name not in NAMED}
    return {name: column for name, column in columns.items() if name in NAMED} | {"more": more}


def _room(shape: tuple[int, ...]) -> UInt8:
    """Return an array to be filled, from Arrow's allocator.

    The C library returns the memory of a batch to the system when it is freed, and the next batch pays for pages anew:
    that took longer than copying the images. Arrow's keeps it (`datasets/__init__.py` says for how long).
    """
    return np.frombuffer(pa.allocate_buffer(math.prod(shape)), np.uint8).reshape(shape)
