"""`mc-floor`: the bootstrapped target, but never less than the return that the episode really had.

Beyond the paper. Bias: docs/estimators/mc-floor.md. Dimensions: B batch, T = 1 step.
"""

import dataclasses

import torch
from torch import Tensor

from graspq.common.options import setting
from graspq.train.acting import StochasticSearch
from graspq.train.batch import Batch
from graspq.train.estimator import Estimator, TargetValue
from graspq.train.estimators import dql
from graspq.train.state import Networks
from graspq.train.targets import floored


@dataclasses.dataclass(frozen=True)
class McFloorSettings(dql.DqlSettings):
    """Options of `mc-floor`."""

    # The best that was measured; with 0.9 its policy waits in most scenes.
    discount: float = setting(0.8, help="Discount.", minimum=0, maximum=1)


def target(
    batch: Batch, networks: Networks, settings: McFloorSettings, random: torch.Generator, progress: float
) -> Tensor:
    """Return max(R_t, r_t + γ V(s_{t+1})), V as in `dql`; float [B, T]. See `targets.floored`.

    Source: Wilcox et al. 2022, "Monte Carlo Augmented Actor-Critic for Sparse Reward Deep RL from Suboptimal
    Demonstrations", without its actor.
    """
    return floored(batch.mc_return, dql.target(batch, networks, settings, random, progress))


row = Estimator(
    summary="Beyond the paper: the larger of the bootstrapped target and the observed return",
    settings=McFloorSettings,
    target_value=TargetValue("larger of bootstrapped and episode value", target, needs_next=True),
    action_selection=StochasticSearch(),
    paper=McFloorSettings(loss="huber"),
)
