"""The paper's unified view: an estimator says what Q(s, a) is regressed onto, and how an action is picked.

A row of the table is an `Estimator` in a file of its own under `estimators/`; what most rows share stands here: the
losses and the regression. Dimensions: B batch, T steps, A action, n real steps of a batch.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Generic, Literal, TypeVar

import torch
from torch import Tensor
from torch.nn import functional

from graspq.common.options import Settings, setting
from graspq.datasets.pool import ShardPool
from graspq.train.acting import ActionSelection
from graspq.train.batch import Batch
from graspq.train.networks import Parts, q_network
from graspq.train.networks.network import Link
from graspq.train.recipe import DEFAULT, PAPER, Recipe
from graspq.train.state import Networks, TrainState

Metrics = dict[str, Tensor]
"""Scalars without gradient, by name: `loss`, and means of absolute values that the task keeps near [0, 1]."""


@dataclasses.dataclass(frozen=True)
class EstimatorSettings(Settings):
    """Options of one estimator; they follow the common ones in `grasp-train --algo NAME --help`."""

    @property
    def lag(self) -> int | None:
        """Steps between copies of the weights into lagged networks; None: there are none."""
        return None

    @property
    def unused_parts(self) -> frozenset[str]:
        """Names of the estimator's networks that these settings have no use for."""
        return frozenset()

    @property
    def counts_episodes(self) -> bool:
        """Whether `--batch-size` counts whole episodes, not transitions; read where a batch holds episodes."""
        return False

    def chosen_discount(self, stored: float) -> float:
        """Return γ of the run; `stored` is that of the dataset's own returns."""
        return stored


S = TypeVar("S", bound=EstimatorSettings)
Target = Callable[[Batch, Networks, S, torch.Generator, float], Tensor]
"""(batch, networks, own settings, random numbers, progress in [0, 1]) -> targets, float [B, T]."""


@dataclasses.dataclass(frozen=True)
class TargetValue(Generic[S]):
    """What Q is regressed onto.

    Attributes:
        words: the paper's for it.
        target: see `Target`; called without gradient, all networks in evaluation mode.
        view: what a batch holds: single transitions (T = 1), or whole episodes, of about `--batch-size` transitions.
        needs_next: whether the target reads s'; in episodes that is the next step, where the mask is true.
        needs_return: whether it reads `mc_return`, which is then made with the run's discount; else it is as stored.

    Raises:
        ValueError: s' is asked of episodes.
    """

    words: str
    target: Target[S]
    view: Literal["transitions", "episodes"] = "transitions"
    needs_next: bool = False
    needs_return: bool = True

    def __post_init__(self) -> None:
        """Check that a batch can hold what the target reads."""
        if self.needs_next and self.view == "episodes":
            raise ValueError("needs_next: episodes hold s' as their next step; leave it out with view='episodes'")


@dataclasses.dataclass(frozen=True)
class Loss:
    """A loss between raw outputs and targets, float [n] each -> float [n], and the link by which outputs are Q."""

    link: Link
    of: Callable[[Tensor, Tensor], Tensor]


def cross_entropy(output: Tensor, target: Tensor) -> Tensor:
    """Return -y log Q - (1 - y) log(1 - Q) with Q = 1 / (1 + exp(-output)), for targets y in [0, 1]; float [n].

    Its minimum over Q is the mean of y, as that of the squared error is.
    Differs: the paper regresses with `squared`, its code with `huber`. Returns are probabilities of success here, for
    which this is the likelihood; it does not lose its gradient where Q is sure and wrong.
    """
    return functional.binary_cross_entropy_with_logits(output, target, reduction="none")


def squared(output: Tensor, target: Tensor) -> Tensor:
    """Return ½ (Q - y)² with Q = output; float [n].

    Source: Quillen et al. 2018, section "Off-Policy Q-Learning".
    """
    return 0.5 * (output - target) ** 2


def huber(output: Tensor, target: Tensor) -> Tensor:
    """Return ½ (Q - y)² where |Q - y| ≤ 1, else |Q - y| - ½, with Q = output; float [n].

    Source: the released code of Quillen et al. 2018; their text has `squared`.
    """
    return functional.huber_loss(output, target, reduction="none")


LOSSES = {
    "cross-entropy": Loss("logistic", cross_entropy),
    "squared": Loss("identity", squared),
    "huber": Loss("identity", huber),
}


@dataclasses.dataclass(frozen=True)
class RegressionSettings(EstimatorSettings):
    """Options of every estimator that is a regression of Q."""

    loss: Literal["cross-entropy", "squared", "huber"] = setting("cross-entropy", help="Loss between Q and target.")


@dataclasses.dataclass(frozen=True)
class LaggedSettings(EstimatorSettings):
    """Options of an estimator whose target asks lagged copies of its networks."""

    discount: float = setting(0.9, help="Discount.", minimum=0, maximum=1)
    lag_steps: int = setting(50, help="Steps between copies of the weights into the lagged networks.", minimum=1)

    @property
    def lag(self) -> int:
        """`lag_steps`."""
        return self.lag_steps

    def chosen_discount(self, stored: float) -> float:
        """Return γ of the targets."""
        return self.discount


@dataclasses.dataclass(frozen=True)
class EpisodeSettings(EstimatorSettings):
    """Options of an estimator that trains on whole episodes, in the paper's preset on a number of them."""

    batch_of: Literal["transitions", "episodes"] = setting(
        "transitions",
        help="What --batch-size counts: transitions, of as many episodes as have them on average; or those.",
    )

    @property
    def counts_episodes(self) -> bool:
        """Whether `batch_of` says so."""
        return self.batch_of == "episodes"


def chosen_loss(settings: Any) -> Loss:
    """Return the loss that the settings name."""
    return LOSSES[settings.loss]


def regression(
    estimator: "Estimator[S]", state: TrainState, batch: Batch, settings: S, random: torch.Generator, progress: float
) -> Metrics:
    """Take one gradient step on the mean loss between Q_θ(s, a) and the estimator's target.

    θ ← θ - optimiser(∇_θ mean ℓ(Q_θ(s_t, a_t), y_t)),  y_t fixed
    """
    target = targets_of(estimator, batch, state.networks, settings, random, progress)
    return step_towards(estimator, state, batch, target, settings)


def regression_objective(
    estimator: "Estimator[S]", batch: Batch, networks: Networks, settings: S, random: torch.Generator, progress: float
) -> Tensor:
    """Return the mean loss between Q_θ(s, a) and the estimator's target, a scalar."""
    target = targets_of(estimator, batch, networks, settings, random, progress)
    return loss_of(estimator, batch, target, networks, settings)["loss"]


@dataclasses.dataclass(frozen=True)
class Estimator(Generic[S]):
    """One row of the paper's table.

    Attributes:
        summary: one line for people.
        settings: its options.
        target_value: what Q is regressed onto.
        action_selection: how its policy finds an action; training never asks.
        paper: its options with `--preset paper`.
        recipe: the common options, where this estimator was measured to learn better with others.
        paper_recipe: the common options with `--preset paper`, where the authors' code has others for this estimator.
        regressed_action: the action whose Q is regressed onto the target, float [B, T, A]; the logged one.
        loss: own settings -> the loss; that of `LOSSES` which they name.
        parts: its networks; Q(s, a) of `--network`.
        kept: (training data, own settings) -> tensors that are kept beside the networks from the start; none.
        update: one step of training, returns metrics; one of its own need not ask `target_value.target`.
        objective: the loss that validation reports, mean over a batch; changes nothing.
    """

    summary: str
    settings: type[S]
    target_value: TargetValue[S]
    action_selection: ActionSelection
    paper: S
    recipe: Recipe = DEFAULT
    paper_recipe: Recipe = PAPER
    regressed_action: Callable[[Batch], Tensor] = lambda batch: batch.action
    loss: Callable[[S], Loss] = chosen_loss
    parts: Parts = dataclasses.field(default_factory=lambda: {"q": q_network})
    kept: Callable[[ShardPool, S], dict[str, Tensor]] = lambda pool, settings: {}
    update: Callable[["Estimator[S]", TrainState, Batch, S, torch.Generator, float], Metrics] = regression
    objective: Callable[["Estimator[S]", Batch, Networks, S, torch.Generator, float], Tensor] = regression_objective

    def recipe_of(self, preset: str) -> Recipe:
        """Return the common options of a preset, `default` or `paper`."""
        return self.paper_recipe if preset == "paper" else self.recipe

    def parts_of(self, settings: S) -> Parts:
        """Return the networks of a run with these settings."""
        return {name: maker for name, maker in self.parts.items() if name not in settings.unused_parts}


def targets_of(
    estimator: Estimator[S], batch: Batch, networks: Networks, settings: S, random: torch.Generator, progress: float
) -> Tensor:
    """Return the estimator's target of every real step, float32 [n], without gradient; leaves networks in eval mode."""
    for network in networks.online.values():
        network.eval()
    with torch.no_grad(), networks.autocast():
        return batch.real(estimator.target_value.target(batch, networks, settings, random, progress)).float()


def step_towards(estimator: Estimator[S], state: TrainState, batch: Batch, target: Tensor, settings: S) -> Metrics:
    """Take one gradient step of Q_θ towards targets of the real steps, float32 [n]."""
    state.networks.q.train()
    metrics = loss_of(estimator, batch, target, state.networks, settings)
    state.descend("q", metrics["loss"])
    return {name: value.detach() for name, value in metrics.items()}


def loss_of(estimator: Estimator[S], batch: Batch, target: Tensor, networks: Networks, settings: S) -> Metrics:
    """Return the mean loss of Q_θ, as it stands, against targets [n], and mean |Q| and |target|; float32 scalars."""
    with networks.autocast():
        action = batch.real(estimator.regressed_action(batch))
        output = networks.q(batch.real(batch.image), batch.real(batch.step), action).float()
    q = networks.q.value_of(output.detach()).abs().mean()
    return {"loss": batch.mean(estimator.loss(settings).of(output, target)), "q": q, "target": target.abs().mean()}
