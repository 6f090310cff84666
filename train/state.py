"""Everything that training changes: the networks, the optimiser's moments and the step.

All else, such as the order of samples, augmentation, candidates and learning rate, is a function of settings and step.
"""

import contextlib
import copy
import dataclasses
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from graspq.common.seeding import integer_seed
from graspq.train.networks import NetworkSpecification, QNetwork, make_network
from graspq.train.updates import LossName

if TYPE_CHECKING:
    from graspq.train.settings import TrainSettings


@dataclasses.dataclass
class TrainState:
    """The state of a run.

    Attributes:
        step: gradient steps taken.
        network: Q_θ, which is trained.
        lagged: Q_θ', a copy of Q_θ of at most `lag_steps` ago; in evaluation mode always.
        averaged: exponential moving average of θ, or None where it is off; in evaluation mode always.
        optimizer: AdamW over θ.
    """

    step: int
    network: QNetwork
    lagged: QNetwork
    averaged: QNetwork | None
    optimizer: torch.optim.AdamW

    @property
    def policy_network(self) -> QNetwork:
        """The network that policies and validation use."""
        return self.network if self.averaged is None else self.averaged

    @property
    def networks(self) -> dict[str, QNetwork]:
        """All networks by name, as a checkpoint keeps them."""
        every = {"network": self.network, "lagged": self.lagged, "averaged": self.averaged}
        return {name: network for name, network in every.items() if network is not None}

    @property
    def optimizers(self) -> dict[str, tuple[torch.optim.Optimizer, nn.Module]]:
        """All optimisers by name, each with the network that it trains."""
        return {"optimizer": (self.optimizer, self.network)}


@dataclasses.dataclass(frozen=True)
class Context:
    """What targets and updates may use besides the batch.

    Attributes:
        network: Q_θ (in validation: the network that is judged).
        lagged: Q_θ'.
        loss: name of the loss.
        discount: γ.
        candidates: actions among which a target looks for the best.
        generator: random numbers of this step, on the CPU.
        progress: part of the training that is done, in [0, 1), for annealed coefficients.
        autocast: gives the context manager under which networks run.
    """

    network: QNetwork
    lagged: QNetwork
    loss: LossName
    discount: float
    candidates: int
    generator: torch.Generator
    progress: float
    autocast: Callable[[], contextlib.AbstractContextManager[object]]


def seeded(purpose: str, *keys: int) -> torch.Generator:
    """Return a CPU generator that depends on purpose and keys alone; see `common.seeding`.

    Torch uses 32 bits of the seed: among millions of steps a few streams coincide, by chance.
    """
    return torch.Generator().manual_seed(integer_seed(purpose, *keys))


def new_state(specification: NetworkSpecification, settings: "TrainSettings", device: torch.device) -> TrainState:
    """Return the state before the first step."""
    network = make_network(specification, seeded("train/weights", settings.seed)).to(device)
    return TrainState(
        step=0,
        network=network,
        lagged=_frozen_copy(network),
        averaged=_frozen_copy(network) if settings.average_decay > 0 else None,
        optimizer=_optimizer(network, settings),
    )


def _frozen_copy(network: QNetwork) -> QNetwork:
    return copy.deepcopy(network).eval().requires_grad_(False)


def _optimizer(network: QNetwork, settings: "TrainSettings") -> torch.optim.AdamW:
    # Gains and biases are left alone: decay towards zero means nothing for them.
    weights = [parameter for parameter in network.parameters() if parameter.dim() > 1]
    others = [parameter for parameter in network.parameters() if parameter.dim() <= 1]
    groups = [
        {"params": weights, "weight_decay": settings.weight_decay},
        {"params": others, "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, lr=settings.learning_rate, fused=True)


def learning_rate(settings: "TrainSettings", step: int) -> float:
    """Return the learning rate of step number `step`, counted from 0.

    warming up:  η (step + 1) / w,  w = warmup · steps
    then:        η (constant), or ½ η (1 + cos(π (step - w) / (steps - w))) (cosine)
    """
    warm = settings.warmup * settings.steps
    if step + 1 < warm:
        return settings.learning_rate * (step + 1) / warm
    if settings.schedule == "constant":
        return settings.learning_rate
    done = (step - warm) / max(settings.steps - warm, 1)
    return settings.learning_rate * 0.5 * (1 + math.cos(math.pi * min(max(done, 0.0), 1.0)))


@torch.no_grad()
def advance(state: TrainState, settings: "TrainSettings") -> None:
    """Count a step that was taken, and let the averaged and the lagged network follow.

    The average's decay is min(d, (1 + n) / (10 + n)) after n steps, so that the first weights are soon forgotten.
    """
    state.step += 1
    if state.averaged is not None:
        decay = min(settings.average_decay, (1 + state.step) / (10 + state.step))
        for mean, value in zip(_tensors(state.averaged), _tensors(state.network), strict=True):
            if mean.is_floating_point():
                mean.lerp_(value, 1 - decay)
            else:
                mean.copy_(value)
    if state.step % settings.lag_steps == 0:
        for old, new in zip(_tensors(state.lagged), _tensors(state.network), strict=True):
            old.copy_(new)


def _tensors(network: QNetwork) -> list[Tensor]:
    return [*network.parameters(), *network.buffers()]
