"""Everything that training changes: the networks, the optimisers' moments, what an estimator keeps besides, the step.

All else, such as the order of samples, augmentation, candidates and learning rate, is a function of settings and step.
"""

import contextlib
import copy
import dataclasses
import math
from collections.abc import Mapping
from typing import cast

import torch
from torch import Tensor, nn

from graspq.common.seeding import integer_seed
from graspq.train.device import Precision
from graspq.train.networks import Parts, build
from graspq.train.networks.network import NetworkSpecification, QNetwork
from graspq.train.parallel import ALONE, Ranks
from graspq.train.recipe import Recipe


@dataclasses.dataclass(frozen=True)
class Networks:
    """The networks of an estimator, as targets and updates see them.

    Attributes:
        online: θ by part (in validation: the networks that are judged).
        lagged: θ' by part: copies of at most `lag_steps` ago, in evaluation mode; empty where the estimator has none.
        kept: tensors that the estimator keeps besides: coefficients that it tunes, what it measured of the data.
        specification: of all networks; its `action` says what an action means.
        precision: under which networks run.
    """

    online: Mapping[str, nn.Module]
    lagged: Mapping[str, nn.Module]
    kept: dict[str, Tensor]
    specification: NetworkSpecification
    precision: Precision

    @property
    def q(self) -> QNetwork:
        """Q_θ."""
        return cast(QNetwork, self.online["q"])

    @property
    def lagged_q(self) -> QNetwork:
        """Q_θ'."""
        return cast(QNetwork, self.lagged["q"])

    def autocast(self) -> contextlib.AbstractContextManager[object]:
        """Return the context manager under which networks run."""
        return self.precision.autocast()


@dataclasses.dataclass
class TrainState:
    """The state of a run.

    Attributes:
        step: gradient steps taken.
        networks: θ and θ', and what the estimator keeps besides.
        averaged: exponential moving averages of θ by part, empty where they are off; in evaluation mode always.
        optimizers: one AdamW for each part.
    """

    step: int
    networks: Networks
    averaged: Mapping[str, nn.Module]
    optimizers: dict[str, torch.optim.AdamW]

    @property
    def acting(self) -> Networks:
        """The networks that policies and validation use."""
        return dataclasses.replace(self.networks, online=self.averaged or self.networks.online)

    @property
    def named_networks(self) -> dict[str, nn.Module]:
        """All networks, by the names that a checkpoint gives them: `q`, `lagged-q`, `averaged-q`, `actor` ..."""
        groups = {"": self.networks.online, "lagged-": self.networks.lagged, "averaged-": self.averaged}
        return {prefix + part: network for prefix, group in groups.items() for part, network in group.items()}

    def descend(self, part: str, loss: Tensor) -> None:
        """Take one step of a part's optimiser down the gradient of a loss."""
        self.optimizers[part].zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizers[part].step()

    def slow_down(self, part: str, factor: float) -> None:
        """Multiply the learning rate of a part's next step, which the loop sets anew before every update."""
        for group in self.optimizers[part].param_groups:
            group["lr"] *= factor

    def set_rate(self, part: str, rate: float) -> None:
        """Set the learning rate of a part's next step."""
        for group in self.optimizers[part].param_groups:
            group["lr"] = rate


def seeded(purpose: str, *keys: int) -> torch.Generator:
    """Return a CPU generator that depends on purpose and keys alone; see `common.seeding`.

    Torch uses 32 bits of the seed: among millions of steps a few streams coincide, by chance.
    """
    return torch.Generator().manual_seed(integer_seed(purpose, *keys))


def new_state(
    specification: NetworkSpecification,
    parts: Parts,
    recipe: Recipe,
    seed: int,
    precision: Precision,
    *,
    lagged: bool,
    ranks: Ranks = ALONE,
) -> TrainState:
    """Return the state before the first step, with nothing kept besides yet.

    Args:
        specification: of all networks.
        parts: the networks of the estimator.
        recipe: of the run.
        seed: of the initial weights.
        precision: arithmetic, and the device where everything lies.
        lagged: whether there are lagged copies.
        ranks: those that train together.
    """
    online = {
        part: build(maker, specification, seeded(f"train/weights/{part}", seed)).to(precision.device)
        for part, maker in parts.items()
    }
    optimizers = {part: _optimizer(network, recipe) for part, network in online.items()}
    for part, optimizer in optimizers.items():
        ranks.attach(online[part], optimizer)
    networks = Networks(online, _frozen_copies(online) if lagged else {}, {}, specification, precision)
    return TrainState(0, networks, _frozen_copies(online) if recipe.average_decay > 0 else {}, optimizers)


def _frozen_copies(networks: Mapping[str, nn.Module]) -> dict[str, nn.Module]:
    return {part: copy.deepcopy(network).eval().requires_grad_(False) for part, network in networks.items()}


def _optimizer(network: nn.Module, recipe: Recipe) -> torch.optim.AdamW:
    # Gains and biases are left alone: decay towards zero means nothing for them.
    weights = [parameter for parameter in network.parameters() if parameter.dim() > 1]
    others = [parameter for parameter in network.parameters() if parameter.dim() <= 1]
    groups = [
        {"params": weights, "weight_decay": recipe.weight_decay},
        {"params": others, "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, lr=recipe.learning_rate, fused=True)


def learning_rate(recipe: Recipe, step: int) -> float:
    """Return the learning rate of step number `step`, counted from 0: a function, so that resuming needs no state.

    warming up:  η (step + 1) / w,  w = warmup · steps
    then:        η (constant), or ½ η (1 + cos(π (step - w) / (steps - w))) (cosine)
    """
    warm = recipe.warmup * recipe.last_step
    if step + 1 < warm:
        return recipe.learning_rate * (step + 1) / warm
    if recipe.schedule == "constant":
        return recipe.learning_rate
    done = (step - warm) / max(recipe.last_step - warm, 1)
    return recipe.learning_rate * 0.5 * (1 + math.cos(math.pi * min(max(done, 0.0), 1.0)))


@torch.no_grad()
def advance(state: TrainState, average_decay: float, lag_steps: int | None) -> None:
    """Count a step that was taken, and let the averaged and the lagged networks follow.

    The average's decay is min(d, (1 + n) / (10 + n)) after n steps, so that the first weights are soon forgotten.

    Args:
        state: of the run.
        average_decay: d.
        lag_steps: steps between copies into the lagged networks; None where there are none.
    """
    state.step += 1
    decay = min(average_decay, (1 + state.step) / (10 + state.step))
    for part, averaged in state.averaged.items():
        for mean, value in zip(_tensors(averaged), _tensors(state.networks.online[part]), strict=True):
            if mean.is_floating_point():
                mean.lerp_(value, 1 - decay)
            else:
                mean.copy_(value)
    if lag_steps is not None and state.step % lag_steps == 0:
        for part, lagged in state.networks.lagged.items():
            for old, new in zip(_tensors(lagged), _tensors(state.networks.online[part]), strict=True):
                old.copy_(new)


def _tensors(network: nn.Module) -> list[Tensor]:
    return [*network.parameters(), *network.buffers()]
