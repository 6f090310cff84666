"""The paper's unified view as data: an estimator is a row that says what Q(s, a) is regressed onto, and how.

A new estimator is one more row, or one row and a file with its own update. Dimensions: B batch, T steps.

Differs, for all rows with default options (`--preset paper` undoes it all):
1. The loss is the cross-entropy of Q in [0, 1] rather than the squared error of an unbounded Q.
2. Batches of 256 rather than 32, shifted and mirrored images, weight decay, a learning rate that falls to 0.
3. Policies use a moving average of the weights.
4. The network is `DefaultNetwork`.
"""

import dataclasses
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from graspq.common.errors import UserError
from graspq.common.named_objects import named_module
from graspq.datasets.pool import ShardPool
from graspq.train.batch import Batch
from graspq.train.blend import blended_target, measured_regression, nothing_measured
from graspq.train.corrected import corrected_target
from graspq.train.ddpg import actor_critic, lagged_actor_target
from graspq.train.pcl import consistent_value, first_penalty, path_consistency, residual
from graspq.train.selection import uniform_search
from graspq.train.state import Context, Parts
from graspq.train.supervised import measured_motions, synthetic_action
from graspq.train.targets import bootstrapped, episode_value
from graspq.train.updates import Objective, Update, regression, regression_objective

View = Literal["transitions", "episodes"]
Acting = Literal["search", "synthetic search", "actor"]
"""How a policy finds its action: CEM over Q; CEM over whole displacements, of which one step is taken; the actor."""


def logged_action(batch: Batch) -> Tensor:
    """Return the actions that were taken; float32 [B, T, A]."""
    return batch.action


def nothing_more(pool: ShardPool) -> dict[str, Tensor]:
    """Return no tensors: most estimators keep their networks alone."""
    return {}


@dataclasses.dataclass(frozen=True)
class Estimator:
    """One row of the paper's table.

    Attributes:
        summary: one line for people.
        target_value: the paper's word for the target.
        action_selection: the paper's word for how actions are picked.
        view: what a batch holds: single transitions, or whole episodes.
        needs_next: whether the target reads s'.
        discount: γ where `--discount` is not given; None: the one that the dataset's returns were made with. The
            batch's `mc_return` is of the run's γ: it is made anew from the rewards where the dataset's is another.
        takes_discount: whether `--discount` can be given.
        target: (batch, context) -> float [B, T]; called without gradient, all networks in evaluation mode.
        action: the action whose Q is regressed onto the target; float [B, T, A].
        update: one step of training.
        objective: the loss that validation reports, mean over a batch; called without gradient, in evaluation mode.
        parts: its networks and their numbers of outputs.
        acting: how its policy finds an action.
        extra: training data -> tensors that are kept in `TrainState.extra` from the start.
    """

    summary: str
    target_value: str
    action_selection: str
    view: View
    needs_next: bool
    discount: float | None
    target: Callable[[Batch, Context], Tensor]
    action: Callable[[Batch], Tensor] = logged_action
    update: Update = regression
    objective: Objective = regression_objective
    parts: Parts = dataclasses.field(default_factory=lambda: {"q": 1})
    acting: Acting = "search"
    extra: Callable[[ShardPool], dict[str, Tensor]] = nothing_more
    takes_discount: bool = True

    def chosen_discount(self, given: float | None, dataset: float) -> float:
        """Return γ for a run.

        Args:
            given: what the user asked for, or None.
            dataset: that of the dataset's `mc_return`.

        Raises:
            UserError: a discount was given to an estimator that takes none.
        """
        if given is not None and not self.takes_discount:
            raise UserError(
                f"--discount: {self.target_value!r} targets have no discount, got {given:g}; leave the option out"
            )
        if given is not None:
            return given
        return dataset if self.discount is None else self.discount


def monte_carlo_target(batch: Batch, context: Context) -> Tensor:
    """Return the observed return; see `targets.episode_value`. For `supervised`, without discount, it is the outcome.

    Source: Quillen et al. 2018, section "Regression with Monte Carlo Return Estimates".
    Differs: 1. No discount by default, as the paper's footnote and its code have it; its formula has one. With
    `--discount` the returns are made anew from the rewards.
    """
    return episode_value(batch.mc_return)


def double_q_target(batch: Batch, context: Context) -> Tensor:
    """Return r + γ Q_θ'(s', a*) with a* the best for Q_θ of uniformly drawn actions; see `targets.bootstrapped`.

    One trunk pass of each network on s', whatever the number of candidates.

    Source: Quillen et al. 2018, section "Off-Policy Q-Learning": 16 uniform candidates, a copy every 50 updates.
    Differs: 1. The lagged network runs with the running statistics of batch normalisation that it was copied with; the
    paper's network has none.
    """
    image, step = batch.next_states
    drawn = context.candidate_actions(torch.ones_like(batch.terminal), batch.action.shape[-1])
    best = uniform_search(context.network.at(image, step), drawn)
    next_value = context.lagged.at(image, step)(best.action.unsqueeze(1)).squeeze(1)
    return bootstrapped(batch.reward, batch.terminal, next_value.view_as(batch.reward), context.discount)


ESTIMATORS: dict[str, Estimator] = {
    "supervised": Estimator(
        summary="The outcome of the episode, as if one motion had led from the current pose to the last one",
        target_value="episode value, on synthetic actions",
        action_selection="stochastic search",
        view="transitions",
        needs_next=False,
        discount=1.0,
        target=monte_carlo_target,
        action=synthetic_action,
        acting="synthetic search",
        extra=measured_motions,
        takes_discount=False,
    ),
    "dql": Estimator(
        summary="Double Q-learning: the reward and the discounted value of the best next action",
        target_value="bootstrapped (double Q, lagged target network)",
        action_selection="stochastic search",
        view="transitions",
        needs_next=True,
        discount=0.9,
        target=double_q_target,
    ),
    "mc": Estimator(
        summary="Monte-Carlo evaluation: the return that the episode really had",
        target_value="episode value",
        action_selection="stochastic search",
        view="transitions",
        needs_next=False,
        discount=None,
        target=monte_carlo_target,
    ),
    "corr-mc": Estimator(
        summary="Monte-Carlo returns, corrected by how much worse than the best the later actions were",
        target_value="corrected episode value, coefficient nu annealed 0 -> 1",
        action_selection="stochastic search",
        view="episodes",
        needs_next=False,
        discount=0.9,
        target=corrected_target,
    ),
    "ddpg": Estimator(
        summary="Deep deterministic policy gradient: a network learns to give the action that Q rates best",
        target_value="bootstrapped",
        action_selection="actor network",
        view="transitions",
        needs_next=True,
        discount=0.9,
        target=lagged_actor_target,
        update=actor_critic,
        parts={"q": 1, "actor": 4},
        acting="actor",
    ),
    "pcl": Estimator(
        summary="Trust-PCL: V and a Gaussian policy, made consistent along logged paths near its lagged copy",
        target_value="corrected episode value (Trust-PCL: relative entropy to a lagged policy)",
        action_selection="actor network",
        view="episodes",
        needs_next=False,
        discount=0.9,
        target=consistent_value,
        update=path_consistency,
        objective=residual,
        parts={"v": 1, "actor": 8},
        acting="actor",
        extra=first_penalty,
    ),
    "blend": Estimator(
        summary="Beyond the paper: bootstrapped where Q is found right on the data, else the corrected return",
        target_value="between bootstrapped and corrected episode value, by the error that is measured",
        action_selection="stochastic search",
        view="episodes",
        needs_next=False,
        discount=0.9,
        target=blended_target,
        update=measured_regression,
        extra=nothing_measured,
    ),
}


def estimator_named(name: str) -> Estimator:
    """Return the row of `--algo`: one of the table's, or a user's own as `module:row`.

    Raises:
        UserError: there is none of that name, or what is there is no row.
    """
    if name in ESTIMATORS:
        return ESTIMATORS[name]
    module_name, _, row_name = name.partition(":")
    if not module_name or not row_name:
        raise UserError(f"--algo: {name!r} is unknown; choose from {', '.join(ESTIMATORS)}, or module:row of your own")
    try:
        row = getattr(named_module(module_name), row_name, None)
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise UserError(f"--algo: {name}: cannot be imported ({reason}); run it where {module_name} is") from error
    if not isinstance(row, Estimator):
        raise UserError(f"--algo: {name}: expected an Estimator, {module_name} has {type(row).__name__} {row_name!r}")
    return row


def as_markdown() -> str:
    """Return the table of estimators in Markdown, as the README shows it."""
    lines = ["| `--algo` | target value | action selection |", "|---|---|---|"]
    lines += [f"| `{name}` | {row.target_value} | {row.action_selection} |" for name, row in ESTIMATORS.items()]
    return "\n".join(lines) + "\n"
