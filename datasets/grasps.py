"""The door for other code: `graspq.open(...)` gives `Grasps`, batches and episodes of one or more datasets.

Dimension key: B batch, T steps, A parts of an action, H W C image.
"""

import functools
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np

from graspq.common.action_space import ActionSpace
from graspq.common.errors import UserError
from graspq.datasets.batch import EpisodeBatch, TransitionBatch
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
        return self.pool.episode(self.pool.blocks[index], number - int(self._starts[index]))

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

        return TorchDataset(functools.partial(self.batches, batch_size, seed, view), options)
