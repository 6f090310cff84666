"""Several processes that train one network together, each on its part of every batch: the ranks that `torchrun` starts.

What they learn is what one process learns, up to rounding: the batches, the random draws and the statistics of batch
normalisation are those of the whole batch, and gradients are averaged before every optimiser's step.

Dimensions: B rows of a rank's part of a batch, T steps, n real steps, C channels.
"""

import contextlib
import dataclasses
import os
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar, cast

import torch
import torch.distributed as dist
from torch import Tensor, nn

from graspq.common.errors import UserError

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

    def sum(self, values: Tensor) -> Tensor:
        """Return the sum over all ranks, without gradient; alone, `values` themselves."""
        if self.count == 1:
            return values
        total = values.detach().clone()
        dist.all_reduce(total)
        return total

    def longest(self, length: int) -> int:
        """Return the greatest length of all ranks; all wait for each other here."""
        if self.count == 1:
            return length
        greatest = torch.tensor(length)
        dist.all_reduce(greatest, dist.ReduceOp.MAX)
        return int(greatest)

    def any(self, flag: bool) -> bool:
        """Return whether the flag is set on any rank; all wait for each other here."""
        return bool(self.longest(int(flag)))

    def from_first(self, function: Callable[[], Result]) -> Result:
        """Return on every rank what the function gives on the first, which alone calls it.

        Raises:
            UserError: the function raised it; then it is raised on every rank.
        """
        if self.count == 1:
            return function()
        outcome: list[Any] = [None]
        if self.first:
            try:
                outcome = [(True, function())]
            except UserError as error:
                outcome = [(False, error.message)]
        dist.broadcast_object_list(outcome, src=0, device=torch.device("cpu"))
        succeeded, value = outcome[0]
        if not succeeded:
            raise UserError(value)
        return cast(Result, value)

    def spread(self, tensors: Iterable[Tensor]) -> None:
        """Overwrite the tensors with those of the first rank."""
        if self.count > 1:
            for tensor in tensors:
                sent = tensor.detach().contiguous()
                dist.broadcast(sent, src=0)
                tensor.detach().copy_(sent)


ALONE = Ranks()


@dataclasses.dataclass(frozen=True)
class BatchPart:
    """Which rows of a batch a rank has; the whole batch of one process by default.

    Attributes:
        ranks: those that share the batch.
        rows: of the whole batch; None where this is all of it.
        share: real steps of this part over their mean number in a part. A rank's mean loss times its share, averaged
            over ranks, is the mean loss of the batch.
    """

    ranks: Ranks = ALONE
    rows: int | None = None
    share: Tensor | float = 1.0

    @classmethod
    def of(cls, ranks: Ranks, rows: int, real: Tensor) -> "BatchPart":
        """Return a rank's part.

        Args:
            ranks: those that share the batch.
            rows: of the whole batch.
            real: number of real steps in this part, a scalar.
        """
        if ranks.count == 1:
            return cls()
        own = real.to(torch.float32)
        return cls(ranks, rows, own * ranks.count / ranks.sum(own))

    def draw(self, size: int, make: Callable[[int], Tensor]) -> Tensor:
        """Return this part of random numbers that are drawn for all rows: those that one process would draw.

        Args:
            size: B.
            make: number of rows -> tensor of so many rows.
        """
        if self.rows is None:
            return make(size)
        # As `numpy.array_split` cuts it in the sampler.
        each, more = divmod(self.rows, self.ranks.count)
        first = self.ranks.rank * each + min(self.ranks.rank, more)
        return make(self.rows)[first : first + size]

    def mean(self, value: Tensor) -> Tensor:
        """Return the mean over the real steps of the whole batch; `value` is that over this part's, any shape."""
        if self.ranks.count == 1:
            return value
        return self.ranks.sum(value * self.share) / self.ranks.count

    def sum_by_step(self, values: Tensor) -> Tensor:
        """Return the sum over all parts of [..., T], as long as the longest of them: parts end with their episodes."""
        if self.ranks.count == 1:
            return values
        missing = self.ranks.longest(values.shape[-1]) - values.shape[-1]
        return self.ranks.sum(torch.nn.functional.pad(values, (0, missing)))


WHOLE = BatchPart()


@contextlib.contextmanager
def joined(device: str) -> Iterator[Ranks]:
    """Meet the other ranks where `torchrun` started this process, and leave them at the end.

    Args:
        device: `--device`. With GPUs each rank of a machine takes its own, and NCCL; else the ranks meet by Gloo.

    Raises:
        UserError: a machine has more ranks than GPUs.
    """
    count = int(os.environ.get("WORLD_SIZE", "1"))
    if count == 1:
        yield ALONE
        return
    graphics = device != "cpu" and torch.cuda.is_available()
    if graphics:
        local, present = int(os.environ["LOCAL_RANK"]), torch.cuda.device_count()
        if local >= present:
            raise UserError(f"--nproc-per-node: expected at most {present}, the GPUs here; or give --device cpu")
        torch.cuda.set_device(local)
    dist.init_process_group("cpu:gloo,cuda:nccl" if graphics else "gloo")
    try:
        yield Ranks(dist.get_rank(), count)
    finally:
        dist.destroy_process_group()


def unite(networks: Iterable[nn.Module], optimizers: Iterable[torch.optim.Optimizer], ranks: Ranks = ALONE) -> None:
    """Make networks and optimisers those of all ranks: common batch statistics, averaged gradients.

    Differs: from torch's `SyncBatchNorm` in that it works on CPUs too.
    """
    if ranks.count == 1:
        return
    for network in networks:
        for parent in list(network.modules()):
            for name, child in list(parent.named_children()):
                if type(child) is nn.BatchNorm2d:
                    setattr(parent, name, _CommonBatchNorm(child))
    for optimizer in optimizers:
        optimizer.register_step_pre_hook(lambda optimizer, *_: _average_gradients(optimizer, ranks))


def _average_gradients(optimizer: torch.optim.Optimizer, ranks: Ranks) -> None:
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    # One message: its cost is mostly that of waiting for each other.
    flat = torch.cat([gradient.reshape(-1) for gradient in gradients])
    dist.all_reduce(flat)
    pieces = torch.split(flat.div_(ranks.count), [gradient.numel() for gradient in gradients])
    for gradient, piece in zip(gradients, pieces, strict=True):
        gradient.copy_(piece.view_as(gradient))


class _CommonBatchNorm(nn.BatchNorm2d):
    """Batch normalisation with the mean and variance of all ranks' parts; state and results as the one it replaces."""

    def __init__(self, replaced: nn.BatchNorm2d) -> None:
        super().__init__(replaced.num_features, replaced.eps, replaced.momentum)
        self.weight, self.bias = replaced.weight, replaced.bias
        for name, buffer in replaced.named_buffers():
            setattr(self, name, buffer)
        self.train(replaced.training)

    def forward(self, input: Tensor) -> Tensor:
        if not self.training:
            return super().forward(input)
        shape = (1, -1, 1, 1)
        values = input.float()
        count = torch.full((1,), values.numel() / values.shape[1], device=values.device)
        sums: Tensor = _total(torch.cat([values.sum((0, 2, 3)), count]))
        total, mean = sums[-1].detach(), sums[:-1] / sums[-1].detach()
        centred = values - mean.view(shape)
        variance: Tensor = _total(centred.square().sum((0, 2, 3))) / total
        self._follow(mean.detach(), variance.detach() * total / (total - 1))
        scale = self.weight * torch.rsqrt(variance + self.eps)
        return (centred * scale.view(shape) + self.bias.view(shape)).to(input.dtype)

    @torch.no_grad()
    def _follow(self, mean: Tensor, variance: Tensor) -> None:
        """Let the running statistics follow; `variance` is the unbiased one."""
        momentum = 0.1 if self.momentum is None else self.momentum
        assert self.running_mean is not None and self.running_var is not None
        assert self.num_batches_tracked is not None
        self.num_batches_tracked += 1
        self.running_mean.lerp_(mean, momentum)
        self.running_var.lerp_(variance, momentum)


class _Total(torch.autograd.Function):
    """The sum over ranks. Every rank's result depends on it, so its gradient is the sum of all ranks' gradients."""

    @staticmethod
    def forward(context: Any, values: Tensor) -> Tensor:
        total = values.clone()
        dist.all_reduce(total)
        return total

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> Tensor:
        total = gradient.clone(memory_format=torch.contiguous_format)
        dist.all_reduce(total)
        return total


@torch.compiler.disable  # type: ignore[untyped-decorator, unused-ignore]
def _total(values: Tensor) -> Tensor:
    return cast(Tensor, _Total.apply(values))  # type: ignore[no-untyped-call]
