"""`td-lambda`: the mean over n of the n-step targets, with weights that fall by λ a step.

Beyond the paper: between `dql` (λ = 0) and `mc` (λ = 1). Bias and variance: docs/estimators/td-lambda.md.
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
from graspq.train.targets import lambda_return


@dataclasses.dataclass(frozen=True)
class TdLambdaSettings(DqlSettings):
    """Options of `td-lambda`; `lambda` is a word of Python's own."""

    trace_decay: float = setting(0.5, help="Lambda: 0 is dql, 1 is mc with the same discount.", minimum=0, maximum=1)


def target(
    batch: Batch, networks: Networks, settings: TdLambdaSettings, random: torch.Generator, progress: float
) -> Tensor:
    """Return r_t + γ [(1 - λ) V(s_{t+1}) + λ y_{t+1}], V by double Q; float [B, T]. See `targets.lambda_return`.

    Source: Sutton and Barto 2018, section 12.1; Peng and Williams 1996 for Q-learning ("Peng's Q(λ)").
    Differs: 1. Nothing is cut where a logged action was not the best (Watkins's Q(λ)): for λ > 0 the mean lies between
    Q* and the value of the policy that collected the data. 2. A batch holds whole episodes.
    """
    value = values_by_double_q(batch, networks, settings.candidates, random)
    return lambda_return(batch.reward, value, settings.trace_decay, settings.discount, batch.mask)


row = Estimator(
    summary="Beyond the paper: TD(lambda), the fading mean of all n-step targets; between dql and mc",
    settings=TdLambdaSettings,
    target_value=TargetValue("lambda-return (double Q)", target, view="episodes", needs_return=False),
    action_selection=StochasticSearch(),
    paper=TdLambdaSettings(loss="huber"),
)
