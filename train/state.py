"""Everything that training changes: the networks, the optimisers' moments, what an estimator keeps besides, the step.

All else, such as the order of samples, augmentation, candidates and learning rate, is a function of settings and step.
"""

import contextlib
import copy
import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Literal, cast

import torch
from torch import Tensor, nn

from graspq.common.seeding import integer_seed
from graspq.train.distributed import WHOLE, BatchPart
from graspq.train.networks import NetworkSpecification, QNetwork, make_network, make_state_network
from graspq.train.selection import uniform_actions
from graspq.train.updates import LossName

if TYPE_CHECKING:
    from graspq.train.settings import TrainSettings

Part = Literal["q", "v", "actor"]
"""What a network is for: Q(s, a), V(s), or the action of s."""
Parts = Mapping[Part, int]
"""The networks of an estimator, each with its number of outputs (1 for Q and V)."""
Networks = dict[Part, nn.Module]


@dataclasses.dataclass
class TrainState:
    """The state of a run.

    Attributes:
        step: gradient steps taken.
        learned: θ, the networks that are trained, by part.
        lagged: θ', copies of them of at most `lag_steps` ago; in evaluation mode always.
        averaged: exponential moving averages of θ, empty where they are off; in evaluation mode always.
        optimizers: one AdamW for each part.
        extra: tensors that an estimator keeps besides: coefficients that it tunes, what it measured of the data.
        parts: which networks there are.
    """

    step: int
    learned: Networks
    lagged: Networks
    averaged: Networks
    optimizers: dict[Part, torch.optim.AdamW]
    extra: dict[str, Tensor]
    parts: Parts

    @property
    def device(self) -> torch.device:
        """Where everything lies."""
        return next(parameter.device for network in self.learned.values() for parameter in network.parameters())

    @property
    def acting(self) -> Networks:
        """The networks that policies and validation use."""
        return self.averaged or self.learned

    @property
    def networks(self) -> dict[str, nn.Module]:
        """All networks, by the names that a checkpoint gives them: `q`, `lagged-q`, `averaged-q`, `actor` ..."""
        groups = {"": self.learned, "lagged-": self.lagged, "averaged-": self.averaged}
        return {prefix + part: network for prefix, group in groups.items() for part, network in group.items()}

    @property
    def tensors(self) -> list[Tensor]:
        """All that a checkpoint keeps, but the step; always in the same order, whichever order it was loaded in."""
        networks = [tensor for network in self.networks.values() for tensor in _tensors(network)]
        moments = [
            moment
            for part, optimizer in self.optimizers.items()
            for parameter in self.learned[part].parameters()
            for _, moment in sorted(optimizer.state.get(parameter, {}).items())
        ]
        return [*networks, *moments, *(tensor for _, tensor in sorted(self.extra.items()))]


@dataclasses.dataclass(frozen=True)
class Context:
    """What targets and updates may use besides the batch.

    Attributes:
        networks: θ (in validation: the networks that are judged).
        lagged_networks: θ'.
        loss: name of the loss.
        discount: γ.
        candidates: actions among which a target looks for the best.
        generator: random numbers of this step, on the CPU.
        progress: part of the training that is done, in [0, 1), for annealed coefficients.
        autocast: gives the context manager under which networks run.
        extra: `TrainState.extra`.
        anneal: part of the training over which a coefficient is annealed.
        centred: whether advantages are shifted so that targets agree with θ' on average.
        mirror: whether what one network picks on the mirror image is judged by another on the image.
        path_steps: d of path consistency; None is the rest of the episode.
        penalty: λ of path consistency; None lets the estimator tune it to `kl_bound`.
        kl_bound: what the mean relative entropy to the lagged policy is tuned to, nats.
        actor_rest: part of the training in which an actor that follows Q stays as it began.
        actor_every: steps of Q from one step of an actor that follows it to the next.
        actor_rate: learning rate of an actor over that of Q or V.
        watched: mean absolute values of what the task keeps near [0, 1], by name, left here by updates: the loop stops
            the run where one is out of all reason.
        part: which rows of the whole batch are here, where several ranks train together.
    """

    networks: Networks
    lagged_networks: Networks
    loss: LossName
    discount: float
    candidates: int
    generator: torch.Generator
    progress: float
    autocast: Callable[[], contextlib.AbstractContextManager[object]]
    extra: dict[str, Tensor]
    anneal: float = 0.5
    centred: bool = False
    mirror: bool = False
    path_steps: int | None = None
    penalty: float | None = None
    kl_bound: float = 0.02
    actor_rest: float = 0.0
    actor_rate: float = 1.0
    actor_every: int = 1
    watched: dict[str, Tensor] = dataclasses.field(default_factory=dict)
    part: BatchPart = WHOLE

    def candidate_actions(self, wanted: Tensor, dimensions: int) -> Tensor:
        """Draw N uniform actions for each of the wanted states; float32 [n, N, A], on their device.

        A state's draws depend on its place in the whole batch alone, not on which others are wanted or on which rank:
        so does the second call of a step, where all ranks have equally many steps T.

        Args:
            wanted: bool [B, T], n of them true.
            dimensions: A.
        """

        def draw(rows: int) -> Tensor:
            return uniform_actions(self.generator, rows, self.candidates, dimensions)

        # Step by step: episodes are padded to different lengths on different ranks.
        drawn = [self.part.draw(len(wanted), draw) for _ in range(wanted.shape[1])]
        return torch.stack(drawn, 1).to(wanted.device)[wanted]

    @property
    def network(self) -> QNetwork:
        """Q_θ."""
        return cast(QNetwork, self.networks["q"])

    @property
    def lagged(self) -> QNetwork:
        """Q_θ'."""
        return cast(QNetwork, self.lagged_networks["q"])


def seeded(purpose: str, *keys: int) -> torch.Generator:
    """Return a CPU generator that depends on purpose and keys alone; see `common.seeding`.

    Torch uses 32 bits of the seed: among millions of steps a few streams coincide, by chance.
    """
    return torch.Generator().manual_seed(integer_seed(purpose, *keys))


def new_state(
    specification: NetworkSpecification,
    settings: "TrainSettings",
    device: torch.device,
    parts: Parts,
) -> TrainState:
    """Return the state before the first step, with nothing in `extra` yet.

    Args:
        specification: of all networks.
        settings: of the run.
        device: where everything lies.
        parts: the networks of the estimator.
    """
    learned: Networks = {
        part: make_part(part, specification, outputs, seeded(f"train/weights/{part}", settings.seed)).to(device)
        for part, outputs in parts.items()
    }
    return TrainState(
        step=0,
        learned=learned,
        lagged=_frozen_copies(learned),
        averaged=_frozen_copies(learned) if settings.average_decay > 0 else {},
        optimizers={part: _optimizer(network, settings) for part, network in learned.items()},
        extra={},
        parts=dict(parts),
    )


def make_part(
    part: Part, specification: NetworkSpecification, outputs: int, generator: torch.Generator | None = None
) -> nn.Module:
    """Return a freshly initialised network of an estimator; see `networks.make_network`."""
    if part == "q":
        return make_network(specification, generator)
    return make_state_network(specification, outputs, generator)


def _frozen_copies(networks: Networks) -> Networks:
    return {part: _frozen_copy(network) for part, network in networks.items()}


def _frozen_copy(network: nn.Module) -> nn.Module:
    return copy.deepcopy(network).eval().requires_grad_(False)


def _optimizer(network: nn.Module, settings: "TrainSettings") -> torch.optim.AdamW:
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
    """Count a step that was taken, and let the averaged and the lagged networks follow.

    The average's decay is min(d, (1 + n) / (10 + n)) after n steps, so that the first weights are soon forgotten.
    """
    state.step += 1
    decay = min(settings.average_decay, (1 + state.step) / (10 + state.step))
    for part, averaged in state.averaged.items():
        for mean, value in zip(_tensors(averaged), _tensors(state.learned[part]), strict=True):
            if mean.is_floating_point():
                mean.lerp_(value, 1 - decay)
            else:
                mean.copy_(value)
    if state.step % settings.lag_steps == 0:
        for part, lagged in state.lagged.items():
            for old, new in zip(_tensors(lagged), _tensors(state.learned[part]), strict=True):
                old.copy_(new)


def _tensors(network: nn.Module) -> list[Tensor]:
    return [*network.parameters(), *network.buffers()]
