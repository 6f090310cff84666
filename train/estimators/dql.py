"""`dql`: double Q-learning. Q(s, a) is regressed onto the reward and the discounted value of the best next action.

Dimensions: B batch, T = 1 step, A action, N candidates.
"""

import dataclasses

import torch
from torch import Tensor

from graspq.common.options import setting
from graspq.train.acting import StochasticSearch
from graspq.train.batch import Batch
from graspq.train.estimator import Estimator, LaggedSettings, RegressionSettings, TargetValue
from graspq.train.selection import uniform_actions
from graspq.train.state import Networks
from graspq.train.targets import bootstrapped, double_q


@dataclasses.dataclass(frozen=True)
class DqlSettings(LaggedSettings, RegressionSettings):
    """Options of `dql`."""

    candidates: int = setting(16, help="Uniform actions among which a target looks for the best.", minimum=1)


def target(batch: Batch, networks: Networks, settings: DqlSettings, random: torch.Generator, progress: float) -> Tensor:
    """Return r + γ V(s'), V by double Q of N uniform actions; float [B, T]. See `targets.bootstrapped` and `double_q`.

    One trunk pass of each network on s', whatever the number of candidates.

    Source: Quillen et al. 2018, section "Off-Policy Q-Learning": 16 uniform candidates, a copy every 50 updates.
    Differs: 1. The lagged network runs with the running statistics of batch normalisation that it was copied with; the
    paper's network has none.
    """
    image, step = batch.next_states
    drawn = uniform_actions(random, len(image), settings.candidates, batch.action.shape[-1]).to(image.device)
    next_value = double_q(networks.q.at(image, step)(drawn), drawn, networks.lagged_q.at(image, step))
    return bootstrapped(batch.reward, batch.terminal, batch.before(next_value), settings.discount)


row = Estimator(
    summary="Double Q-learning: the reward and the discounted value of the best next action",
    settings=DqlSettings,
    target_value=TargetValue(
        "bootstrapped (double Q, lagged target network)", target, needs_next=True, needs_return=False
    ),
    action_selection=StochasticSearch(),
    paper=DqlSettings(loss="huber"),
)
