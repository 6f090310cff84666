"""`nstep`: the rewards of the next n steps and the value of the state after them.

Beyond the paper: between `dql` (n = 1) and `mc` (n = T). Bias and variance: docs/estimators/nstep.md.
Dimensions: B batch, T steps.
"""

import dataclasses

import torch
from torch import Tensor

from graspq.common.options import setting
from graspq.train.acting import StochasticSearch
from graspq.train.advantages import values_by_double_q
from graspq.train.batch import Batch
from graspq.train.estimator import Estimator, TargetValue
from graspq.train.estimators.dql import DqlSettings
from graspq.train.state import Networks
from graspq.train.targets import n_step


@dataclasses.dataclass(frozen=True)
class NstepSettings(DqlSettings):
    """Options of `nstep`."""

    n: int = setting(
        2, help="Steps whose rewards count as they were; 1 is dql, that of the longest episode mc.", minimum=1
    )


def target(
    batch: Batch, networks: Networks, settings: NstepSettings, random: torch.Generator, progress: float
) -> Tensor:
    """Return r_t + .. + γ^{n-1} r_{t+n-1} + γⁿ V(s_{t+n}), V by double Q; float [B, T]. See `targets.n_step`.

    Source: Sutton and Barto 2018, section 7.1; Hessel et al. 2018, "Rainbow", section "Multi-step Learning" (n = 3).
    Differs: 1. No importance weights: for n > 1 the mean is of n - 1 actions of the policy that collected the data, and
    the best action after them. 2. A batch holds whole episodes.
    """
    value = values_by_double_q(batch, networks, settings.candidates, random)
    return n_step(batch.reward, value, settings.discount, settings.n, batch.mask)


row = Estimator(
    summary="Beyond the paper: the rewards of n steps and the value after them; between dql and mc",
    settings=NstepSettings,
    target_value=TargetValue("bootstrapped after n steps (double Q)", target, view="episodes", needs_return=False),
    action_selection=StochasticSearch(),
    paper=NstepSettings(loss="huber"),
)
