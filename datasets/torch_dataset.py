"""Batches of a dataset as PyTorch's own `IterableDataset`."""

from collections.abc import Callable, Iterator
from typing import Any

from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info


class TorchDataset(IterableDataset[dict[str, Tensor]]):
    """The endless batches of `Grasps.batches`, each a dictionary of tensors by name.

    For `DataLoader(dataset, batch_size=None)`, which must not batch again. Worker processes are not needed, since a
    thread reads ahead; of n workers each takes every n-th batch, so that the batches and their order stay the same.
    """

    def __init__(self, batches: Callable[..., Any], options: dict[str, Any]) -> None:
        """Prepare.

        Args:
            batches: `Grasps.batches` with its first arguments given.
            options: the others.
        """
        self.batches, self.options = batches, options

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        """Return the batches from `start_step` on."""
        worker = get_worker_info()
        options = dict(self.options)
        if worker is not None:
            options["start_step"] = options.get("start_step", 0) + worker.id
            options["every"] = worker.num_workers
        with self.batches(**options) as batches:
            for batch in batches:
                yield batch.tensors()
