"""What `graspq.open(...)` gives: logged grasps of any number of datasets, as batches to train on and as episodes.

Dimension key: B batch, T steps, A parts of an action, H W C image.
"""

import functools
import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np

from graspq.common.action_space import ActionSpace
from graspq.common.errors import UserError
from graspq.datasets.blocks import BlockArrays, BlockRef, read_block, read_columns, read_episode_rows
from graspq.datasets.columns import RecordType, record_dtype
from graspq.datasets.episode import Episode
from graspq.datasets.images import decoded
from graspq.datasets.loader import DEFAULT_BUFFER_BYTES, Gather, Loader, in_order
from graspq.datasets.sampler import Sampler
from graspq.datasets.samples import EpisodeBatch, TransitionBatch, gather_episodes, gather_transitions

if TYPE_CHECKING:
    from graspq.datasets.torch_dataset import TorchDataset

View = Literal["transitions", "episodes"]
# Attributes of an episode that the episodes table holds as they are.
AS_THEY_ARE = ("episode_id", "block", "seed", "ended_by", "success", "lifted_object", "policy", "exploration")


@dataclass(frozen=True, eq=False, repr=False)
class ShardPool:
    """Logged grasps, ready to be trained on; as a sequence it holds the episodes, in the order of the blocks.

    They agree in task and its settings, version of the simulator, object set and its split, image shape, action space
    and discount: `open_shards` refuses to mix others.

    Attributes:
        blocks: ordered by seed of the dataset, then by number: the order in which they were named does not matter.
        task: the task's settings; `task["name"]` is its name, `task["max_steps"]` the longest episode T.
        image_shape: (H, W, C).
        action: what an action means: names, units and limits of its A parts.
        discount: γ of `mc_return`: the stored one, or that of `with_discount`.
        object_set: `name` and `sha256` of the object set.
        manifest_digest: that of the manifest where the pool is one whole dataset, else that of the shards' digests.
    """

    blocks: tuple[BlockRef, ...]
    task: dict[str, Any]
    image_shape: tuple[int, int, int]
    action: ActionSpace
    discount: float
    object_set: dict[str, Any]
    manifest_digest: str
    _footers: dict[Path, Any] = field(default_factory=dict)
    _contents: dict[Path, bytes] = field(default_factory=dict)
    _relabels: bool = False

    @property
    def rows(self) -> int:
        """Number of transitions."""
        return sum(ref.rows for ref in self.blocks)

    @property
    def episodes(self) -> int:
        """Number of episodes, each one grasp attempt."""
        return sum(ref.episodes for ref in self.blocks)

    @property
    def max_steps(self) -> int:
        """T, the task's greatest number of steps."""
        return int(self.task["max_steps"])

    @property
    def row_bytes(self) -> int:
        """Memory of one step when it is read."""
        return math.prod(self.image_shape) + self._record.itemsize

    @functools.cached_property
    def _record(self) -> RecordType:
        return record_dtype(self.image_shape, self.action)

    @property
    def folders(self) -> tuple[Path, ...]:
        """Folders of the datasets that the blocks lie in, each once."""
        return tuple(dict.fromkeys(ref.path.absolute().parent.parent for ref in self.blocks))

    def __len__(self) -> int:
        return self.episodes

    def __repr__(self) -> str:
        folders = ", ".join(map(str, self.folders))
        return f"<{self.episodes:,} grasps of the {self.task['name']} task, {self.rows:,} steps, from {folders}>"

    def __getitem__(self, number: int) -> Episode:
        """Return one episode.

        Args:
            number: 0 .. `episodes` − 1, in the order of the blocks; negative ones count from the end.

        Raises:
            IndexError: there is no such episode.
            UserError: a file is missing or damaged.
        """
        if not -self.episodes <= number < self.episodes:
            raise IndexError(f"episode {number}: there are {self.episodes}")
        number %= self.episodes
        starts = np.cumsum([0, *(ref.episodes for ref in self.blocks)])
        index = int(np.searchsorted(starts, number, side="right")) - 1
        return self._block_episodes(self.blocks[index])[number - int(starts[index])]

    def __iter__(self) -> Iterator[Episode]:
        """Return the episodes in order; each block is read once."""
        return (episode for ref in self.blocks for episode in self._block_episodes(ref))

    def _block_episodes(self, ref: BlockRef) -> list[Episode]:
        block = self.read_block(ref)
        rows = read_episode_rows(ref.path.parent.parent / "episodes" / ref.path.name, ref.block)
        episodes = []
        for row, first, length in zip(rows, block.first_rows.tolist(), block.lengths.tolist(), strict=True):
            records, final = block.records[first : first + length], row.get("final_image")
            episodes.append(
                Episode(
                    images=block.images[first : first + length].copy(),
                    actions=np.ascontiguousarray(records["action"]),
                    rewards=np.ascontiguousarray(records["reward"]),
                    gripper_poses=np.ascontiguousarray(records["gripper_pose"]),
                    object_ids=tuple(row["object_ids"]),
                    object_poses=np.array(row["object_poses"], np.float32).reshape(-1, 7),
                    final_pose=np.array(row["final_pose"], np.float32),
                    final_image=None if final is None else decoded(final, self.image_shape).copy(),
                    **{name: row[name] for name in AS_THEY_ARE},
                )
            )
        return episodes

    def read_block(self, ref: BlockRef) -> BlockArrays:
        """Return the rows of a block; see `blocks.read_block`. Safe to call from several threads."""
        block = read_block(ref, self.image_shape, self._record, *self._known(ref))
        return block.with_discount(self.discount) if self._relabels else block

    def read_columns(self, ref: BlockRef, names: Sequence[str]) -> dict[str, Any]:
        """Return some stored columns of a block; see `blocks.read_columns`."""
        return read_columns(ref, names, *self._known(ref))

    def _known(self, ref: BlockRef) -> tuple[Any, bytes | None]:
        return self._footers.get(ref.path), self._contents.get(ref.path)

    def with_discount(self, discount: float) -> "ShardPool":
        """Return the same grasps with `mc_return` for another γ in [0, 1], made from the rewards."""
        return self if discount == self.discount else replace(self, discount=discount, _relabels=True)

    def split(self, fraction: float = 0.1, seed: int = 0) -> tuple["ShardPool", "ShardPool"]:
        """Return (training, held back): a block, whose episodes share their objects, is held back with a probability.

        Whether it is depends on `seed` and the block's identity alone, so it stays so when the dataset is extended or
        moved. A pool of more than one block gives at least one to each side, unless the fraction is 0.

        Raises:
            UserError: the fraction is outside [0, 1).
        """
        if not 0.0 <= fraction < 1.0:
            raise UserError(f"fraction: expected a number in [0, 1), got {fraction}")
        ranked = sorted(self.blocks, key=lambda ref: _fraction(seed, ref))
        count = sum(_fraction(seed, ref) < fraction for ref in ranked)
        if fraction > 0 and len(ranked) > 1:
            count = min(max(count, 1), len(ranked) - 1)
        elif len(ranked) == 1:
            count = 0
        held_back = set(ranked[:count])
        return (
            replace(self, blocks=tuple(ref for ref in self.blocks if ref not in held_back)),
            replace(self, blocks=tuple(ref for ref in self.blocks if ref in held_back)),
        )

    @overload
    def batches(
        self, batch_size: int = 256, seed: int = 0, *, view: Literal["transitions"] = "transitions", **options: Any
    ) -> Loader[TransitionBatch]: ...

    @overload
    def batches(
        self, batch_size: int = 256, seed: int = 0, *, view: Literal["episodes"], **options: Any
    ) -> Loader[EpisodeBatch]: ...

    def batches(  # type: ignore[misc]  # the options of the overloads are those named here
        self,
        batch_size: int = 256,
        seed: int = 0,
        *,
        view: View = "transitions",
        buffer_bytes: int = DEFAULT_BUFFER_BYTES,
        start_step: int = 0,
        rank: int = 0,
        ranks: int = 1,
        prefetch: int = 2,
        every: int = 1,
        need_next: bool = True,
        last_step_weight: int = 1,
        max_steps: int | None = None,
    ) -> Loader[Any]:
        """Return an endless iterator of batches, the same ones for the same arguments.

        Its order is a function of the seed and the step alone, every epoch another one. A thread reads ahead from the
        first batch on; `close()`, leaving a `with` block, or dropping the iterator ends it. Each batch is a
        `TransitionBatch` or an `EpisodeBatch`: numpy arrays that `torch.from_numpy` takes without a copy, and that
        `batch.tensors(device)` returns as tensors by name.

        Args:
            batch_size: transitions of a batch over all ranks, or episodes.
            seed: whole number ≥ 0.
            view: `"transitions"`, or `"episodes"`: whole episodes padded to T with a mask.
            buffer_bytes: bound on the memory that blocks take; data that fit are read once.
            start_step: global step of the first batch, to resume: the batches are those of an unbroken run.
            rank: this process, 0 .. ranks − 1; it gets its part of each batch.
            ranks: number of processes.
            prefetch: batches assembled ahead; 0 works without a thread.
            every: global steps from one batch to the next: n processes that share the work take every n-th.
            need_next: whether transitions have s′; where no target reads it, leaving it out halves the copying.
            last_step_weight: how often an epoch takes the last step of each episode; all others once. Of transitions.
            max_steps: what episodes are padded to; the task's T if not given.

        Raises:
            UserError: the batch is larger than the data, the buffer too small, or (on iterating) a shard is damaged.
        """
        counts, gather = self._view(view, need_next, max_steps, last_step_weight)
        rows = [ref.rows for ref in self.blocks]
        buffer_rows = buffer_bytes // self.row_bytes
        sampler = Sampler(rows, batch_size, seed, buffer_rows, rank, ranks, items_per_block=counts)
        return Loader(self.read_block, self.blocks, sampler, gather, start_step, every, prefetch)

    @overload
    def once(
        self, batch_size: int = 256, *, view: Literal["transitions"] = "transitions", need_next: bool = True
    ) -> Iterator[TransitionBatch]: ...

    @overload
    def once(
        self, batch_size: int = 256, *, view: Literal["episodes"], need_next: bool = True
    ) -> Iterator[EpisodeBatch]: ...

    def once(self, batch_size: int = 256, *, view: View = "transitions", need_next: bool = True) -> Iterator[Any]:
        """Return all batches once, in the order of the data, to validate on; the last one may be smaller."""
        counts, gather = self._view(view, need_next, None)
        return in_order(self.read_block, self.blocks, counts, batch_size, gather)

    def torch_dataset(
        self, batch_size: int = 256, seed: int = 0, *, view: View = "transitions", **options: Any
    ) -> "TorchDataset":
        """Return `batches` as a `torch.utils.data.IterableDataset` of dictionaries of tensors.

        Hand it to a `DataLoader(..., batch_size=None)`; see `TorchDataset`.
        """
        from graspq.datasets.torch_dataset import TorchDataset

        return TorchDataset(partial(self.batches, batch_size, seed, view=view), options)

    def _view(
        self, view: View, need_next: bool, max_steps: int | None, last_step_weight: int = 1
    ) -> tuple[list[int], Gather[Any]]:
        """Return how many items of a view each block has, and what gathers them."""
        if view == "transitions":
            counts = [ref.rows + (last_step_weight - 1) * ref.episodes for ref in self.blocks]
            return counts, partial(gather_transitions, need_next=need_next)
        if view == "episodes":
            longest = self.max_steps if max_steps is None else max_steps
            return [ref.episodes for ref in self.blocks], partial(gather_episodes, max_steps=longest)
        raise UserError(f"view {view!r}: expected transitions or episodes")


def _fraction(seed: int, ref: BlockRef) -> float:
    """Return a number in [0, 1) that depends on the seed and the block's identity alone."""
    digest = hashlib.sha256(f"held back/{seed}/{ref.key}".encode()).digest()
    return int.from_bytes(digest[:6], "little") / 2**48
