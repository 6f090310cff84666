"""`mc`: Monte-Carlo evaluation. Q(s, a) is regressed onto the return that the episode really had.

Dimensions: B batch, T steps.
"""

import dataclasses
from typing import Any

import torch
from torch import Tensor

from graspq.common.options import setting
from graspq.train.acting import StochasticSearch
from graspq.train.batch import Batch
from graspq.train.estimator import Estimator, RegressionSettings, TargetValue
from graspq.train.state import Networks
from graspq.train.targets import episode_value


@dataclasses.dataclass(frozen=True)
class McSettings(RegressionSettings):
    """Options of `mc`."""

    discount: float | None = setting(
        None,
        help="Discount of the return; data: that of the stored returns, 1 as made by grasp-datagen.",
        minimum=0,
        maximum=1,
        none="data",
    )

    def chosen_discount(self, stored: float) -> float:
        """Return γ of the return."""
        return stored if self.discount is None else self.discount


def target(batch: Batch, networks: Networks, settings: Any, random: torch.Generator, progress: float) -> Tensor:
    """Return the observed return, float [B, T]; see `targets.episode_value`.

    Source: Quillen et al. 2018, section "Regression with Monte Carlo Return Estimates".
    Differs: 1. No discount by default, as the paper's footnote and its code have it; its formula has one.
    """
    return episode_value(batch.mc_return)


row = Estimator(
    summary="Monte-Carlo evaluation: the return that the episode really had",
    settings=McSettings,
    target_value=TargetValue("episode value", target),
    action_selection=StochasticSearch(),
    paper=McSettings(loss="huber"),
)
