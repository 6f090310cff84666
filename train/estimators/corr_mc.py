"""`corr-mc`: the return that the episode really had, less what its later actions were worth against the best (≤ 0).

Dimensions: B batch, T steps. Measurements and why it departs from the paper: docs/estimators/corr-mc.md.
"""

import dataclasses

import torch
from torch import Tensor

from graspq.common.options import setting
from graspq.train.acting import StochasticSearch
from graspq.train.advantages import CorrectionSettings, advantages, lagged_values
from graspq.train.batch import Batch
from graspq.train.estimator import Estimator, TargetValue
from graspq.train.recipe import PAPER
from graspq.train.state import Networks
from graspq.train.targets import corrected_episode_value


@dataclasses.dataclass(frozen=True)
class CorrMcSettings(CorrectionSettings):
    """Options of `corr-mc`."""

    anneal: float = setting(
        1.0, help="Part of the steps over which nu rises from 0 to 1; 0: all at once.", minimum=0, maximum=1
    )


def target(
    batch: Batch, networks: Networks, settings: CorrMcSettings, random: torch.Generator, progress: float
) -> Tensor:
    """Return the observed return minus ν times the later advantages; see `targets.corrected_episode_value`; [B, T].

    Source: Quillen et al. 2018, section "Corrected Monte Carlo Evaluation".
    Differs: 1. V(s) is the lagged network's Q of the best of N uniform actions and the logged one, or that of the
    logged one where this is larger: no advantage is above 0 before they are centred. 2. θ picks the best, on the mirror
    image (`--no-look-in-mirror` with `--preset paper`), and θ' judges it. 3. Advantages are constants of the loss; the
    released code lets gradient through them. 4. They are centred (`--no-centred` with `--preset paper`). 5. ν rises
    over the whole training, over a twentieth with `--preset paper`, which is the released code's 100,000 of 2 million
    steps; the text says "during training". 6. A batch counts transitions; in the released code 32 counts episodes.
    """
    nu = annealed(progress, settings.anneal)
    advantage = advantages(batch, lagged_values(batch, networks, settings, random), nu, settings)
    return corrected_episode_value(batch.reward, advantage, nu, settings.discount, batch.mask)


def annealed(progress: float, part: float) -> float:
    """Return ν = min(progress / part, 1): from 0 to 1 over the first `part` of the training; 1 where that is 0."""
    return min(progress / part, 1.0) if part > 0 else 1.0


row = Estimator(
    summary="Monte-Carlo returns, corrected by how much worse than the best the later actions were",
    settings=CorrMcSettings,
    target_value=TargetValue(
        "corrected episode value, coefficient nu annealed 0 -> 1", target, view="episodes", needs_return=False
    ),
    action_selection=StochasticSearch(),
    paper=CorrMcSettings(loss="squared", lag_steps=100, anneal=0.05, centred=False, look_in_mirror=False),
    paper_recipe=dataclasses.replace(PAPER, learning_rate=1e-4),
)
