"""Copies the samples of a batch out of the blocks in memory: the only copy between the Parquet reader and the learner.

Dimension key: B batch, T steps, H W C image.
"""

import math

import numpy as np
import pyarrow as pa

from graspq.datasets.batch import EpisodeBatch, Int64, TransitionBatch, episode_batch, transition_batch
from graspq.datasets.blocks import BlockArrays, opaque
from graspq.datasets.episode import UInt8

Blocks = dict[int, BlockArrays]


def gather_transitions(blocks: Blocks, owners: list[int], rows: list[int], need_next: bool) -> TransitionBatch:
    """Return the batch of row `rows[i]` of block `owners[i]`, for all i."""
    shape = blocks[owners[0]].images.shape[1:]
    image = _room((len(rows), *shape))
    next_image = _room((len(rows), *shape)) if need_next else None
    records = np.empty(len(rows), blocks[owners[0]].records.dtype)
    copied = opaque(records)
    for index, (owner, row) in enumerate(zip(owners, rows, strict=True)):
        block = blocks[owner]
        image[index] = block.images[row]
        if next_image is not None:
            next_image[index] = block.images[block.next_rows[row]]
        copied[index] = block.opaque[row]
    return transition_batch(image, next_image, records)


def gather_episodes(blocks: Blocks, owners: list[int], numbers: list[int], max_steps: int) -> EpisodeBatch:
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
    return episode_batch(image, records, mask)


def located(offsets: Int64, items: Int64) -> tuple[list[int], list[int]]:
    """Return, for each item, its block and its number within that block; `offsets` is the first item of each block."""
    owners = np.searchsorted(offsets, items, side="right") - 1
    return owners.tolist(), (items - offsets[owners]).tolist()


def _room(shape: tuple[int, ...]) -> UInt8:
    """Return an array to be filled, from Arrow's allocator.

    The C library returns the memory of a batch to the system when it is freed, and the next batch pays for pages anew:
    that took longer than copying the images. Arrow's keeps it (`datasets/__init__.py` says for how long).
    """
    return np.frombuffer(pa.allocate_buffer(math.prod(shape)), np.uint8).reshape(shape)
