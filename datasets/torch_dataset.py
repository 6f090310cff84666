"""Batches of a dataset as PyTorch's own `IterableDataset`."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

if TYPE_CHECKING:
    from graspq.datasets.grasps import Grasps, View


class TorchDataset(IterableDataset[dict[str, Tensor]]):
    """The endless batches of `Grasps.batches`, each a dictionary of tensors by name.

    For `DataLoader(dataset, batch_size=None)`, which must not batch again. Worker processes are not needed, since a
    thread reads ahead; of n workers each takes every n-th batch, so that the batches and their order stay the same.
    """

    def __init__(self, grasps: "Grasps", batch_size: int, seed: int, view: "View", options: dict[str, Any]) -> None:
        self.grasps, self.batch_size, self.seed, self.view, self.options = grasps, batch_size, seed, view, options

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        """Return the batches from `start_step` on."""
        worker = get_worker_info()
        options = dict(self.options)
        if worker is not None:
            options["start_step"] = options.get("start_step", 0) + worker.id
            options["every"] = worker.num_workers
        with self.grasps.batches(self.batch_size, self.seed, self.view, **options) as batches:
            for batch in batches:
                yield batch.tensors()
