"""The paper's unified view: an estimator says what Q(s, a) is regressed onto, and how an action is picked.

A row of the table is an `Estimator` in a file of its own under `estimators/`; what most rows share stands here: the
losses and the regression. Dimensions: B batch, T steps, A action, n real steps of a batch.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Generic, Literal, TypeVar

import torch
from torch import Tensor
from torch.nn import functional

from graspq.common.options import Settings, setting
from graspq.common.text import markdown
from graspq.datasets.pool import ShardPool
from graspq.train.acting import ActionSelection
from graspq.train.batch import Batch
from graspq.train.networks import Parts, q_network
from graspq.train.networks.network import Link
from graspq.train.recipe import PAPER, Recipe
from graspq.train.state import Networks, TrainState

Metrics = dict[str, Tensor]
"""Scalars without gradient, by name: `loss`, and means of absolute values that the task keeps near [0, 1]."""


@dataclasses.dataclass(frozen=True)
class EstimatorSettings(Settings):
    """Options of one estimator; they follow the common ones in `grasp-train --algo NAME --help`.

    Two names mean something to the loop: `discount` is that of the returns in a batch, and with `lag_steps` there are
    lagged copies of the networks, which follow after so many steps.
    """

    def chosen_discount(self, stored: float) -> float:
        """Return γ of the run's `mc_return`; `stored` is that of the dataset's own."""
        discount = getattr(self, "discount", None)
        return stored if discount is None else float(discount)


S = TypeVar("S", bound=EstimatorSettings)
Target = Callable[[Batch, Networks, S, torch.Generator, float], Tensor]
"""(batch, networks, own settings, random numbers, progress in [0, 1)) -> targets, float [B, T]."""


@dataclasses.dataclass(frozen=True)
class TargetValue(Generic[S]):
    """What Q is regressed onto.

    Attributes:
        words: the paper's for it.
        target: see `Target`; called without gradient, all networks in evaluation mode.
        view: what a batch holds: single transitions (T = 1), or whole episodes, of about `--batch-size` transitions.
        needs_next: whether the target reads s'; in episodes that is the next step, where the mask is true.

    Raises:
        ValueError: s' is asked of episodes.
    """

    words: str
    target: Target[S]
    view: Literal["transitions", "episodes"] = "transitions"
    needs_next: bool = False

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
    Differs: the paper regresses with `squared`. Returns are probabilities of success here, for which this is the
    likelihood; it does not lose its gradient where Q is sure and wrong.
    """
    return functional.binary_cross_entropy_with_logits(output, target, reduction="none")


def squared(output: Tensor, target: Tensor) -> Tensor:
    """Return ½ (Q - y)² with Q = output; float [n].

    Source: Quillen et al. 2018, section "Off-Policy Q-Learning". The released code's Huber loss with δ = 1 is the same
    where |Q - y| ≤ 1.
    """
    return 0.5 * (output - target) ** 2


LOSSES = {"cross-entropy": Loss("logistic", cross_entropy), "squared": Loss("identity", squared)}


@dataclasses.dataclass(frozen=True)
class RegressionSettings(EstimatorSettings):
    """Options of every estimator that is a regression of Q."""

    loss: Literal["cross-entropy", "squared"] = setting("cross-entropy", help="Loss between Q and target.")


@dataclasses.dataclass(frozen=True)
class LaggedSettings(RegressionSettings):
    """Options of an estimator whose target asks a lagged copy of the networks."""

    discount: float = setting(0.9, help="Discount.", minimum=0, maximum=1)
    lag_steps: int = setting(50, help="Steps between copies of the weights into the lagged network.", minimum=1)


def logged_action(batch: Batch) -> Tensor:
    """Return the actions that were taken; float32 [B, T, A]."""
    return batch.action


def chosen_loss(settings: Any) -> Loss:
    """Return the loss that the settings name."""
    return LOSSES[settings.loss]


def nothing_kept(pool: ShardPool, settings: Any) -> dict[str, Tensor]:
    """Return no tensors: most estimators keep their networks alone."""
    return {}


def regression(
    row: "Estimator[S]", state: TrainState, batch: Batch, settings: S, random: torch.Generator, progress: float
) -> Metrics:
    """Take one gradient step on the mean loss between Q_θ(s, a) and the estimator's target.

    θ ← θ - optimiser(∇_θ mean ℓ(Q_θ(s_t, a_t), y_t)),  y_t fixed
    """
    networks = state.networks
    target = targets_of(row, batch, networks, settings, random, progress)
    networks.q.train()
    metrics = loss_of(row, batch, target, networks, settings)
    state.descend("q", metrics["loss"])
    return {name: value.detach() for name, value in metrics.items()}


def regression_objective(
    row: "Estimator[S]", batch: Batch, networks: Networks, settings: S, random: torch.Generator, progress: float
) -> Tensor:
    """Return the mean loss between Q_θ(s, a) and the estimator's target, a scalar."""
    target = targets_of(row, batch, networks, settings, random, progress)
    return loss_of(row, batch, target, networks, settings)["loss"]


@dataclasses.dataclass(frozen=True)
class Estimator(Generic[S]):
    """One row of the paper's table.

    Attributes:
        summary: one line for people.
        settings: its options.
        target_value: what Q is regressed onto.
        action_selection: how its policy finds an action.
        paper: its options with `--preset paper`.
        paper_recipe: the common options with `--preset paper`, where the authors' code has others for this estimator.
        action: the action whose Q is regressed onto the target; float [B, T, A].
        loss: own settings -> the loss.
        parts: its networks.
        kept: (training data, own settings) -> tensors that are kept beside the networks from the start.
        update: one step of training; returns metrics.
        objective: the loss that validation reports, mean over a batch; changes nothing.
    """

    summary: str
    settings: type[S]
    target_value: TargetValue[S]
    action_selection: ActionSelection
    paper: S
    paper_recipe: Recipe = PAPER
    action: Callable[[Batch], Tensor] = logged_action
    loss: Callable[[S], Loss] = chosen_loss
    parts: Parts = dataclasses.field(default_factory=lambda: {"q": q_network})
    kept: Callable[[ShardPool, S], dict[str, Tensor]] = nothing_kept
    update: Callable[["Estimator[S]", TrainState, Batch, S, torch.Generator, float], Metrics] = regression
    objective: Callable[["Estimator[S]", Batch, Networks, S, torch.Generator, float], Tensor] = regression_objective


def targets_of(
    row: Estimator[S], batch: Batch, networks: Networks, settings: S, random: torch.Generator, progress: float
) -> Tensor:
    """Return the estimator's target of every real step, float32 [n], without gradient; leaves networks in eval mode."""
    for network in networks.online.values():
        network.eval()
    with torch.no_grad(), networks.autocast():
        return batch.real(row.target_value.target(batch, networks, settings, random, progress)).float()


def loss_of(row: Estimator[S], batch: Batch, target: Tensor, networks: Networks, settings: S) -> Metrics:
    """Return the mean loss of Q_θ, as it stands, against targets [n], and mean |Q| and |target|; float32 scalars."""
    with networks.autocast():
        output = networks.q(batch.real(batch.image), batch.real(batch.step), batch.real(row.action(batch)))
    output = output.float()
    q = networks.q.value_of(output.detach()).abs().mean()
    return {"loss": row.loss(settings).of(output, target).mean(), "q": q, "target": target.abs().mean()}


def as_markdown(rows: Mapping[str, Estimator[Any]]) -> str:
    """Return the table of estimators in Markdown, as the README shows it."""
    cells = ((f"`{name}`", row.target_value.words, row.action_selection.words) for name, row in rows.items())
    return markdown(("`--algo`", "target value", "action selection"), cells)
