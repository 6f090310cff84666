"""`blend`: between the bootstrapped and the corrected episode value, nearer to that one where Q is measured to be off.

Beyond the paper, whose discussion asks for it. Derivation, limits and measurements: docs/estimators/blend.md.
Dimensions: B batch, T steps, n later steps (real ones after the first of their episode), K cells (steps × bins of Q).
"""

import dataclasses

import torch
from torch import Tensor

from graspq.common.errors import UserError
from graspq.common.options import setting
from graspq.datasets.pool import ShardPool
from graspq.train.acting import StochasticSearch
from graspq.train.advantages import CorrectionSettings, Judge, LaterValues, advantages, later_values
from graspq.train.batch import Batch
from graspq.train.estimator import Estimator, Metrics, TargetValue, step_towards
from graspq.train.state import Networks, TrainState
from graspq.train.targets import blended, corrected_episode_value

BINS = 10
# Errors are remembered for about as many updates as a lagged network lives by default.
DECAY = 1 - 1 / 50


@dataclasses.dataclass(frozen=True)
class BlendSettings(CorrectionSettings):
    """Options of `blend`."""

    judge: Judge = setting("lagged", help="Whose Q of the logged action an advantage takes: online or lagged.")

    def __post_init__(self) -> None:
        """Check all values.

        Raises:
            UserError: a value is out of range, or a gradient is asked for that the update does not take.
        """
        super().__post_init__()
        if self.judge == "online-gradient":
            raise UserError("--judge online-gradient: expected online or lagged with --algo blend")


def nothing_measured(pool: ShardPool, settings: BlendSettings) -> dict[str, Tensor]:
    """Return what is kept: fading sums of the cells' errors as `summed` gives them, none yet; number of later steps."""
    return {
        "blend_errors": torch.zeros(3, pool.max_steps * BINS, dtype=torch.float64),
        "blend_rows": torch.tensor(pool.rows - pool.episodes, dtype=torch.float64),
    }


def cell_of(step: Tensor, q: Tensor) -> Tensor:
    """Return the cell of steps, int64 [n]: its number in the episode, and which tenth of [0, 1] its Q lies in."""
    return step * BINS + (q * BINS).long().clamp(0, BINS - 1)


def summed(cell: Tensor, error: Tensor, cells: int) -> Tensor:
    """Return how many errors each of K cells has, their sum and the sum of their squares; float64 [3, K].

    Args:
        cell: int64 [n].
        error: e of later steps, float [n].
        cells: K.
    """
    error = error.to(torch.float64)
    moments = torch.stack([torch.ones_like(error), error, error**2])
    return moments.new_zeros(3, cells).index_add_(1, cell, moments)


def weights(kept: dict[str, Tensor]) -> Tensor:
    """Return λ of every cell, float64 [K]: the weight of the corrected value that makes the squared error least.

        λ_c = b² / (b² + v / n_c),  b² = max(ē² - v / m - v / n_c, 0)

    with ē mean and v variance of the m seen errors y_t - Q_θ'(s_t, a_t) of a cell, and n_c its training steps. A cell
    that was never seen has λ = 0.
    """
    count, total, square = kept["blend_errors"]
    seen = count.clamp(min=1e-12)
    mean = total / seen
    scatter = (square - total * mean).clamp(min=0)
    # One observation of the common variance: a cell that was seen once would look free of chance.
    variance = (scatter + scatter.sum() / seen.sum()) / seen
    # Steps that fade as these count for (Σ w)² / Σ w² = (1 + d) Σ w full ones.
    chance_of_batches = variance / (seen * (1 + DECAY))
    chance_of_data = variance / (kept["blend_rows"] * seen / seen.sum()).clamp(min=1)
    bias = (mean**2 - chance_of_batches - chance_of_data).clamp(min=0)
    return torch.where(bias > 0, bias / (bias + chance_of_data), torch.zeros_like(bias))


def target(
    batch: Batch, networks: Networks, settings: BlendSettings, random: torch.Generator, progress: float
) -> Tensor:
    """Return the targets with λ as it was measured so far; float [B, T]. See `targets.blended`."""
    values = later_values(batch, networks, settings, random)
    return _target(batch, networks, settings, values, advantages(batch, values, 1.0, settings))


def _target(
    batch: Batch, networks: Networks, settings: BlendSettings, values: LaterValues, advantage: Tensor
) -> Tensor:
    later = batch.later_steps
    weight = torch.zeros_like(batch.reward)
    weight[later] = weights(networks.kept).to(weight.dtype)[cell_of(batch.step[later], values.q[later])]
    return blended(batch.reward, values.value, advantage, weight, settings.discount, batch.mask)


def measured_regression(
    estimator: Estimator[BlendSettings],
    state: TrainState,
    batch: Batch,
    settings: BlendSettings,
    random: torch.Generator,
    progress: float,
) -> Metrics:
    """Measure the lagged network's errors on a batch, then take one step of regression onto the blended targets."""
    networks = state.networks
    networks.q.eval()
    with torch.no_grad(), networks.autocast():
        values = later_values(batch, networks, settings, random)
        advantage = advantages(batch, values, 1.0, settings)
        later = batch.later_steps
        corrected = corrected_episode_value(batch.reward, advantage, 1.0, settings.discount, batch.mask)
        errors = networks.kept["blend_errors"]
        errors.mul_(DECAY)
        errors.add_(summed(cell_of(batch.step[later], values.q[later]), (corrected - values.q)[later], errors.shape[1]))
        wanted = batch.real(_target(batch, networks, settings, values, advantage)).float()
    return step_towards(estimator, state, batch, wanted, settings)


row = Estimator(
    summary="Beyond the paper: bootstrapped where Q is found right on the data, else the corrected return",
    settings=BlendSettings,
    target_value=TargetValue(
        "between bootstrapped and corrected episode value, by the error that is measured",
        target,
        view="episodes",
        needs_return=False,
    ),
    action_selection=StochasticSearch(),
    paper=BlendSettings(loss="huber"),
    update=measured_regression,
    kept=nothing_measured,
)
