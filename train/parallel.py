"""Several processes that train one network together, as `torchrun` starts them; algorithms know nothing of it.

Each rank has its part of every batch and its own random numbers; gradients and running statistics are averaged before
every optimiser's step. Differs: from DistributedDataParallel, which wraps the forward of one module, in that an update
may run several networks, and parts of them.
"""

import contextlib
import dataclasses
import os
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import nn

from graspq.common.errors import CommandError, MachineError, UserError

Result = TypeVar("Result")


@dataclasses.dataclass(frozen=True)
class Ranks:
    """This process's place among those that train together: number `rank` of `count`; alone by default."""

    rank: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        """Whether this is the rank that writes the run folder."""
        return self.rank == 0

    def any(self, flag: bool) -> bool:
        """Return whether the flag is set on any rank; all wait for each other here."""
        if self.count == 1:
            return flag
        found = torch.tensor(float(flag))
        dist.all_reduce(found, dist.ReduceOp.MAX)
        return bool(found)

    def from_first(self, function: Callable[[], Result]) -> Result:
        """Return on every rank what the function gives on the first, which alone calls it.

        Raises:
            UserError, MachineError: the function raised it; then it is raised on every rank.
        """
        if self.count == 1:
            return function()
        outcome: list[Any] = [None]
        if self.first:
            try:
                outcome = [(None, function())]
            except CommandError as error:
                outcome = [(MachineError if isinstance(error, MachineError) else UserError, error.message)]
        dist.broadcast_object_list(outcome, src=0)
        raised, value = outcome[0]
        if raised is not None:
            raise raised(value)
        result: Result = value
        return result

    def attach(self, network: nn.Module, optimizer: torch.optim.Optimizer) -> None:
        """Average the network's gradients and running statistics over ranks before every step of its optimiser."""
        if self.count > 1:
            optimizer.register_step_pre_hook(lambda *_: self._average(network))

    def _average(self, network: nn.Module) -> None:
        gradients = [parameter.grad for parameter in network.parameters() if parameter.grad is not None]
        statistics = [buffer for buffer in network.buffers() if buffer.is_floating_point()]
        tensors = [*gradients, *statistics]
        # One message: its cost is mostly that of waiting for each other.
        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        dist.all_reduce(flat)
        pieces = torch.split(flat.div_(self.count), [tensor.numel() for tensor in tensors])
        for tensor, piece in zip(tensors, pieces, strict=True):
            tensor.copy_(piece.view_as(tensor))


ALONE = Ranks()


@contextlib.contextmanager
def joined() -> Iterator[Ranks]:
    """Meet the other ranks (by Gloo) where `torchrun` started this process, and leave them at the end."""
    count = int(os.environ.get("WORLD_SIZE", "1"))
    if count == 1:
        yield ALONE
        return
    dist.init_process_group("gloo")
    try:
        yield Ranks(dist.get_rank(), count)
    finally:
        dist.destroy_process_group()
