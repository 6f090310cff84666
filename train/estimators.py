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

from torch import Tensor

from graspq.common.errors import UserError
from graspq.train.batch import Batch
from graspq.train.selection import uniform_actions, uniform_search
from graspq.train.state import Context
from graspq.train.targets import bootstrapped, episode_value
from graspq.train.updates import Update, regression

View = Literal["transitions", "episodes"]


def logged_action(batch: Batch) -> Tensor:
    """Return the actions that were taken; float32 [B, T, A]."""
    return batch.action


@dataclasses.dataclass(frozen=True)
class Estimator:
    """One row of the paper's table.

    Attributes:
        summary: one line for people.
        target_value: the paper's word for the target.
        action_selection: the paper's word for how actions are picked.
        view: what a batch holds: single transitions, or whole episodes.
        needs_next: whether the target reads s'.
        discount: γ where `--discount` is not given; None: the one that the dataset's returns were made with, and no
            other can be given.
        target: (batch, context) -> float [B, T]; called without gradient, all networks in evaluation mode.
        action: the action whose Q is regressed onto the target; float [B, T, A].
        update: one step of training.
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

    def chosen_discount(self, given: float | None, dataset: float) -> float:
        """Return γ for a run.

        Args:
            given: what the user asked for, or None.
            dataset: that of the dataset's `mc_return`.

        Raises:
            UserError: the estimator uses the dataset's returns and another discount was asked for.
        """
        if self.discount is not None:
            return self.discount if given is None else given
        if given is not None and given != dataset:
            raise UserError(
                f"--discount: {self.target_value!r} targets are the dataset's returns, made with discount {dataset:g}, "
                f"got {given:g}; leave the option out, or collect the dataset with that discount"
            )
        return dataset


def monte_carlo_target(batch: Batch, context: Context) -> Tensor:
    """Return the observed return; see `targets.episode_value`.

    Source: Quillen et al. 2018, section "Regression with Monte Carlo Return Estimates".
    Differs: 1. No discount, as the paper's footnote and its code have it; its formula has one.
    """
    return episode_value(batch.mc_return)


def double_q_target(batch: Batch, context: Context) -> Tensor:
    """Return r + γ Q_θ'(s', a*) with a* the best for Q_θ of uniformly drawn actions; see `targets.bootstrapped`.

    One trunk pass of each network on s', whatever the number of candidates.

    Source: Quillen et al. 2018, section "Off-Policy Q-Learning": 16 uniform candidates, a copy every 50 updates.
    Differs: 1. The lagged network runs with the running statistics of batch normalisation that it was copied with; the
    paper's network has none.
    """
    if batch.next_image is None or batch.next_step is None:
        raise ValueError("a bootstrapped target needs next_image and next_step in the batch")
    image, step = batch.next_image.flatten(0, 1), batch.next_step.flatten()
    drawn = uniform_actions(context.generator, len(step), context.candidates, batch.action.shape[-1])
    best = uniform_search(context.network.at(image, step), drawn.to(image.device))
    next_value = context.lagged.at(image, step)(best.action.unsqueeze(1)).squeeze(1)
    return bootstrapped(batch.reward, batch.terminal, next_value.view_as(batch.reward), context.discount)


ESTIMATORS: dict[str, Estimator] = {
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
}


def estimator_named(name: str) -> Estimator:
    """Return the row of `--algo`.

    Raises:
        UserError: there is none of that name.
    """
    if name not in ESTIMATORS:
        raise UserError(f"--algo: {name!r} is unknown; choose from {', '.join(ESTIMATORS)}")
    return ESTIMATORS[name]


def as_markdown() -> str:
    """Return the table of estimators in Markdown, as the README shows it."""
    lines = ["| `--algo` | target value | action selection |", "|---|---|---|"]
    lines += [f"| `{name}` | {row.target_value} | {row.action_selection} |" for name, row in ESTIMATORS.items()]
    return "\n".join(lines) + "\n"
