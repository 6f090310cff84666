"""`corr-mc`: the return that the episode really had, less what its later actions were worth against the best.

Dimensions: B batch, T steps, n real steps. Derivation, variants and measurements: docs/estimators/corr-mc.md.
"""

import dataclasses

import torch
from torch import Tensor

from graspq.common.errors import UserError
from graspq.common.options import setting
from graspq.train.acting import StochasticSearch
from graspq.train.advantages import CorrectionSettings, LaterValues, advantages, later_values
from graspq.train.batch import Batch
from graspq.train.estimator import EpisodeSettings, Estimator, Metrics, TargetValue, regression
from graspq.train.recipe import DEFAULT, PAPER
from graspq.train.state import Networks, TrainState
from graspq.train.targets import corrected_episode_value


@dataclasses.dataclass(frozen=True)
class CorrMcSettings(CorrectionSettings, EpisodeSettings):
    """Options of `corr-mc`."""

    discount: float = setting(0.8, help="Discount.", minimum=0, maximum=1)
    anneal: float = setting(
        0.5,
        help="Part of the steps over which nu rises from 0 to 1; 0: all at once; above 1: it does not get there.",
        minimum=0,
    )

    def __post_init__(self) -> None:
        """Check all values.

        Raises:
            UserError: a value is out of range, or the gradient of a loss is asked for that has no use for it.
        """
        super().__post_init__()
        if self.judge == "online-gradient" and self.loss == "cross-entropy":
            # The slope of the cross-entropy in its target does not vanish where the target is met.
            raise UserError("--judge online-gradient: expected --loss squared or huber, got --loss cross-entropy")


def target(
    batch: Batch, networks: Networks, settings: CorrMcSettings, random: torch.Generator, progress: float
) -> Tensor:
    """Return the observed return minus ν times the later advantages; see `targets.corrected_episode_value`; [B, T].

    Source: Quillen et al. 2018, section "Corrected Monte Carlo Evaluation".
    Differs: 1. Q of an advantage is a constant of the loss; the released code lets gradient through it (`--judge
    online-gradient`, with `--preset paper`). 2. ν rises over half of the training; over a twentieth with `--preset
    paper`, which is the released code's 100,000 of 2 million steps (of other numbers: `--anneal` 100,000 / steps); the
    text says "during training". 3. A batch counts transitions; in the released code 32 counts episodes (`--batch-of
    episodes`, with `--preset paper`). 4. The lagged network is copied every 50 steps, the paper's text for `dql`; every
    100 in the released code, and with `--preset paper`. 5. The discount is 0.8, the best that was measured (0.9 with
    `--preset paper`).
    """
    return _target(batch, later_values(batch, networks, settings, random), settings, progress)


def _target(batch: Batch, values: LaterValues, settings: CorrMcSettings, progress: float) -> Tensor:
    nu = annealed(progress, settings.anneal)
    advantage = advantages(batch, values, nu, settings)
    return corrected_episode_value(batch.reward, advantage, nu, settings.discount, batch.mask)


def annealed(progress: float, part: float) -> float:
    """Return ν = min(progress / part, 1): from 0 to 1 over the first `part` of the training; 1 where that is 0."""
    return min(progress / part, 1.0) if part > 0 else 1.0


def corrected_regression(
    estimator: Estimator[CorrMcSettings],
    state: TrainState,
    batch: Batch,
    settings: CorrMcSettings,
    random: torch.Generator,
    progress: float,
) -> Metrics:
    """Take one step of regression; with `--judge online-gradient` down the gradient of the targets' Q as well.

        θ ← θ - optimiser(∇_θ mean ½ (Q_θ(s_t, a_t) - y_t(θ))²),
        y_t(θ) = R_t - ν Σ_{t'=t+1}^{T} γ^{t'-t} (Q_θ(s_t', a_t') - V(s_t'))

    Q_θ of the advantages is that of the same pass; V is a constant.

    Source: released code, `random_continuous_pcl_graph`.
    """
    if settings.judge != "online-gradient":
        return regression(estimator, state, batch, settings, random, progress)
    networks = state.networks
    networks.q.eval()
    with torch.no_grad(), networks.autocast():
        values = later_values(batch, networks, settings, random)
    networks.q.train()
    with networks.autocast():
        output = networks.q(batch.real(batch.image), batch.real(batch.step), batch.real(batch.action)).float()
    q = networks.q.value_of(output)
    wanted = batch.real(_target(batch, values._replace(q=batch.in_place(q)), settings, progress))
    loss = batch.mean(estimator.loss(settings).of(output, wanted))
    state.descend("q", loss)
    return {"loss": loss.detach(), "q": q.detach().abs().mean(), "target": wanted.detach().abs().mean()}


row = Estimator(
    summary="Monte-Carlo returns, corrected by how much worse than the best the later actions were",
    settings=CorrMcSettings,
    target_value=TargetValue(
        "corrected episode value, coefficient nu annealed 0 -> 1", target, view="episodes", needs_return=False
    ),
    action_selection=StochasticSearch(),
    paper=CorrMcSettings(
        loss="huber", discount=0.9, lag_steps=100, anneal=0.05, judge="online-gradient", batch_of="episodes"
    ),
    recipe=dataclasses.replace(DEFAULT, learning_rate=1e-3),
    paper_recipe=dataclasses.replace(PAPER, learning_rate=1e-4),
    update=corrected_regression,
)
