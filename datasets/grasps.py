"""The door for other code: `graspq.open(...)` gives `Grasps`, batches and episodes of one or more datasets.

Dimension key: B batch, T steps, A parts of an action, H W C image.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from graspq.common.action_space import ActionSpace
from graspq.common.errors import UserError
from graspq.datasets.batch import EpisodeBatch, TransitionBatch
from graspq.datasets.blocks import REMEDY, BlockRef
from graspq.datasets.episode import Episode
from graspq.datasets.loader import (
    EpisodeLoader,
    TransitionLoader,
    episode_batches,
    transition_batches,
)
from graspq.datasets.pool import ShardPool

if TYPE_CHECKING:
    from graspq.datasets.torch_dataset import TorchDataset

View = Literal["transitions", "episodes"]


class Grasps:
    """Logged grasps, ready to be trained on; as a sequence it holds the episodes, in their order.

    Attributes:
        pool: the blocks behind it.
    """

    def __init__(self, pool: ShardPool) -> None:
        self.pool = pool
        self._starts = np.cumsum([0, *(ref.episodes for ref in pool.blocks)])

    @property
    def episodes(self) -> int:
        """Number of episodes, each one grasp attempt."""
        return self.pool.episodes

    @property
    def rows(self) -> int:
        """Number of transitions."""
        return self.pool.rows

    @property
    def task(self) -> dict[str, Any]:
        """The task's settings; `task["name"]` is its name, `task["max_steps"]` the longest episode T."""
        return self.pool.task

    @property
    def action(self) -> ActionSpace:
        """What an action means: names, units and limits of its A parts."""
        return self.pool.action

    @property
    def image_shape(self) -> tuple[int, int, int]:
        """(H, W, C) of an image."""
        return self.pool.image_shape

    @property
    def discount(self) -> float:
        """γ of `mc_return`."""
        return self.pool.discount

    def __len__(self) -> int:
        return self.episodes

    def __repr__(self) -> str:
        folders = ", ".join(str(folder) for folder in self.pool.folders)
        return f"<{self.episodes:,} grasps of the {self.task['name']} task, {self.rows:,} steps, from {folders}>"

    def __getitem__(self, number: int) -> Episode:
        """Return one episode.

        Args:
            number: 0 .. `episodes` − 1, in the order of the blocks; negative ones count from the end.

        Raises:
            IndexError: there is no such episode.
            UserError: a file is damaged.
        """
        if not -self.episodes <= number < self.episodes:
            raise IndexError(f"episode {number}: there are {self.episodes}")
        number %= self.episodes
        index = int(np.searchsorted(self._starts, number, side="right")) - 1
        ref = self.pool.blocks[index]
        within = number - int(self._starts[index])
        block, row = self.pool.read_block(ref), _episode_rows(ref)[within]
        first = int(block.first_rows[within])
        steps = slice(first, first + int(block.lengths[within]))
        records = block.records[steps]
        return Episode(
            episode_id=row["episode_id"],
            block=row["block"],
            seed=row["seed"],
            object_ids=tuple(row["object_ids"]),
            object_poses=np.array(row["object_poses"], np.float32).reshape(-1, 7),
            images=block.images[steps].copy(),
            actions=np.ascontiguousarray(records["action"]),
            rewards=np.ascontiguousarray(records["reward"]),
            gripper_poses=np.ascontiguousarray(records["gripper_pose"]),
            final_pose=np.array(row["final_pose"], np.float32),
            end=row["end"],
            success=row["success"],
            lifted_object=row["lifted_object"],
            policy=row["policy"],
            exploration=row["exploration"],
        )

    def split(self, fraction: float = 0.1, seed: int = 0) -> tuple["Grasps", "Grasps"]:
        """Return (training, held back): whole blocks, which share their objects, are held back; see `ShardPool.split`.

        Raises:
            UserError: the fraction is outside [0, 1).
        """
        training, held_back = self.pool.split(fraction, seed)
        return Grasps(training), Grasps(held_back)

    def with_discount(self, discount: float) -> "Grasps":
        """Return the same grasps with `mc_return` for another γ in [0, 1]."""
        return Grasps(self.pool.with_discount(discount))

    @overload
    def batches(
        self, batch_size: int = 256, seed: int = 0, view: Literal["transitions"] = "transitions", **options: Any
    ) -> TransitionLoader: ...

    @overload
    def batches(self, batch_size: int, seed: int, view: Literal["episodes"], **options: Any) -> EpisodeLoader: ...

    @overload
    def batches(
        self, batch_size: int = 256, seed: int = 0, *, view: Literal["episodes"], **options: Any
    ) -> EpisodeLoader: ...

    def batches(
        self, batch_size: int = 256, seed: int = 0, view: View = "transitions", **options: Any
    ) -> TransitionLoader | EpisodeLoader:
        """Return an endless iterator of batches, the same ones for the same arguments.

        Its order is a function of the seed and the step alone, every epoch another one. A thread reads ahead from the
        first batch on; `close()`, leaving a `with` block, or dropping the iterator ends it. Each batch is a
        `TransitionBatch` or an `EpisodeBatch`: numpy arrays that `torch.from_numpy` takes without a copy, and that
        `batch.tensors(device)` returns as tensors by name.

        Args:
            batch_size: transitions of a batch, or episodes.
            seed: whole number ≥ 0.
            view: `"transitions"`, or `"episodes"`: whole episodes padded to T with a mask.
            options: as of `TransitionLoader` and `EpisodeLoader`, such as `start_step` (to resume), `rank` and `ranks`
                (to train on several processes), `need_next` (False leaves s′ out), `buffer_bytes` (memory).

        Raises:
            UserError: the batch is larger than the data, the buffer too small, or (on iterating) a shard is damaged.
        """
        if view == "episodes":
            return EpisodeLoader(self.pool, batch_size, seed, **options)
        if view == "transitions":
            return TransitionLoader(self.pool, batch_size, seed, **options)
        raise UserError(f"view {view!r}: expected transitions or episodes")

    @overload
    def once(
        self, batch_size: int = 256, view: Literal["transitions"] = "transitions"
    ) -> Iterator[TransitionBatch]: ...

    @overload
    def once(self, batch_size: int = 256, *, view: Literal["episodes"]) -> Iterator[EpisodeBatch]: ...

    def once(self, batch_size: int = 256, view: View = "transitions") -> Iterator[TransitionBatch | EpisodeBatch]:
        """Return all batches once, in the order of the data, to validate on; the last one may be smaller."""
        if view == "episodes":
            return episode_batches(self.pool, batch_size)
        return transition_batches(self.pool, batch_size)

    def torch_dataset(
        self, batch_size: int = 256, seed: int = 0, view: View = "transitions", **options: Any
    ) -> "TorchDataset":
        """Return `batches` as a `torch.utils.data.IterableDataset` of dictionaries of tensors.

        Hand it to a `DataLoader(..., batch_size=None)`; see `TorchDataset`.
        """
        from graspq.datasets.torch_dataset import TorchDataset

        return TorchDataset(self, batch_size, seed, view, options)


def _episode_rows(ref: BlockRef) -> list[dict[str, Any]]:
    """Return the rows of a block's episodes.

    Raises:
        UserError: the file is missing or damaged.
    """
    path = ref.path.parent.parent / "episodes" / ref.path.name
    try:
        table = pq.read_table(path, page_checksum_verification=True, use_threads=False, partitioning=None)
    except (OSError, pa.ArrowException, ValueError) as error:
        raise UserError(f"{path}: cannot be read ({' '.join(str(error).split())}); {REMEDY}") from None
    rows: list[dict[str, Any]] = table.filter(pc.field("block") == ref.block).to_pylist()
    return rows
