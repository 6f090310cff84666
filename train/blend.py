"""`blend`: between the bootstrapped and the corrected episode value, nearer to that one where Q is measured to be off.

Beyond the paper, whose discussion asks for it: "adjusting the type of target value based on data availability".
Dimensions: B batch, T steps, A action, N candidates, n later steps (real ones after the first of their episode),
K cells (steps times bins of Q).

What is optimised. At each later step two values may stand for the state: the lagged network's V, or the corrected
rest of the episode, y - A (see `blended`; V and A as in `corrected`, centred). The first is off by what Q still lacks
there, b; the second by chance: what remains of an outcome's variance v among the n_c training steps of the same cell c,
v / n_c, for regression averages over those. The weight λ of the second makes the expected squared error the least:

    λ_c = argmin (1 - λ)² b² + λ² v / n_c = b² / (b² + v / n_c)

Both are measured while training: e_t = y_t - Q_θ'(s_t, a_t), with y the whole corrected episode value, has mean b and
variance v. The mean of m seen errors overstates b² by chance, by v / m, and by v / n_c for the data themselves:

    b² = max(ē² - v / m - v / n_c, 0)

So λ is 1 where Q is wrong beyond doubt, as in the first steps of training; it falls to 0 where Q agrees with the
outcomes up to chance, and the fewer the data are, the larger is what passes for chance. Q* is the fixed point for every
λ that depends on the state and action alone, as it is of both parents: E[e_t | s_t, a_t] = 0 there. Measured on the
tiny decision process of the tests, distance to Q* (dql, corr-mc, blend), 400 steps of training: 0.149, 0.154, 0.132
with 200 episodes; 0.054, 0.086, 0.068 with 20,000; 0.149, 0.138, 0.138 with 20,000 and 120 steps.

Limits: errors are measured on the data that are trained on, not on held-back ones: where the network has learned single
outcomes by heart, e is 0 and both targets are the same. Squared errors of a cell stand for all of its states.
"""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from graspq.datasets.pool import ShardPool
from graspq.train.batch import Batch
from graspq.train.corrected import Judged, advantages, judged, later_steps
from graspq.train.targets import corrected_episode_value
from graspq.train.updates import descend, loss_of

if TYPE_CHECKING:
    from graspq.train.estimators import Estimator
    from graspq.train.state import Context, TrainState

BINS = 10
# Errors are remembered for about as many updates as a lagged network lives by default.
DECAY = 1 - 1 / 50


def blended(
    reward: Tensor, value: Tensor, advantage: Tensor, weight: Tensor, discount: float, mask: Tensor | None = None
) -> Tensor:
    """Return targets between the bootstrapped and the corrected episode value.

        y_t = r_t + γ [(1 - λ_{t+1}) V(s_{t+1}) + λ_{t+1} (y_{t+1} - A(s_{t+1}, a_{t+1}))],  y_T = r_T

    With λ = 0 this is the bootstrapped target, with λ = 1 the corrected episode value with ν = 1.

    Args:
        reward: float [B, T], whole episodes.
        value: V(s_t), float [B, T]; at first steps it is not read.
        advantage: A(s_t, a_t), float [B, T]; at first steps it is not read.
        weight: λ_t in [0, 1], float [B, T]; at first steps it is not read.
        discount: γ in [0, 1].
        mask: bool [B, T], false where an episode has already ended; nothing is read there and the result is 0.

    Returns:
        float [B, T].

    Source: none in the paper. With one λ for all it is Q*(λ) of Harutyunyan et al. 2016, "Q(λ) with Off-Policy
    Corrections", equation 4, for the greedy policy.
    """
    real = torch.ones_like(reward, dtype=torch.bool) if mask is None else mask
    result = torch.zeros_like(reward)
    following = torch.zeros_like(reward[:, 0])
    for t in reversed(range(reward.shape[1])):
        y = reward[:, t] + discount * following
        result[:, t] = torch.where(real[:, t], y, torch.zeros_like(y))
        mixed = (1 - weight[:, t]) * value[:, t] + weight[:, t] * (y - advantage[:, t])
        following = torch.where(real[:, t], mixed, torch.zeros_like(mixed))
    return result


def nothing_measured(pool: ShardPool) -> dict[str, Tensor]:
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


def weights(extra: dict[str, Tensor]) -> Tensor:
    """Return λ of every cell, float64 [K]; see the module. A cell that was never seen has λ = 0."""
    count, total, square = extra["blend_errors"]
    seen = count.clamp(min=1e-12)
    mean = total / seen
    scatter = (square - total * mean).clamp(min=0)
    # One observation of the common variance: a cell that was seen once would look free of chance.
    variance = (scatter + scatter.sum() / seen.sum()) / seen
    # Steps that fade as these count for (Σ w)² / Σ w² = (1 + d) Σ w full ones.
    chance_of_batches = variance / (seen * (1 + DECAY))
    chance_of_data = variance / (extra["blend_rows"] * seen / seen.sum()).clamp(min=1)
    bias = (mean**2 - chance_of_batches - chance_of_data).clamp(min=0)
    return torch.where(bias > 0, bias / (bias + chance_of_data), torch.zeros_like(bias))


def blended_target(batch: Batch, context: "Context") -> Tensor:
    """Return the targets with λ as it was measured so far; float [B, T]."""
    seen = judged(batch, context)
    return _target(batch, context, seen, advantages(batch, seen, 1.0, context))


def _target(batch: Batch, context: "Context", seen: Judged, advantage: Tensor) -> Tensor:
    later = later_steps(batch)
    weight = torch.zeros_like(batch.reward)
    weight[later] = weights(context.extra).to(weight.dtype)[cell_of(batch.step[later], seen.q[later])]
    return blended(batch.reward, seen.value, advantage, weight, context.discount, batch.mask)


def measured_regression(state: "TrainState", batch: Batch, estimator: "Estimator", context: "Context") -> Tensor:
    """Measure the lagged network's errors on a batch, then take one step of regression onto the blended targets."""
    q = state.learned["q"]
    q.eval()
    with torch.no_grad(), context.autocast():
        seen = judged(batch, context)
        advantage = advantages(batch, seen, 1.0, context)
        later = later_steps(batch)
        corrected = corrected_episode_value(batch.reward, advantage, 1.0, context.discount, batch.mask)
        errors = state.extra["blend_errors"]
        new = summed(cell_of(batch.step[later], seen.q[later]), (corrected - seen.q)[later], errors.shape[1])
        errors.mul_(DECAY).add_(context.part.ranks.sum(new))
        target = batch.real(_target(batch, context, seen, advantage)).float()
    context.watched["target"] = target.abs().mean()
    q.train()
    loss = loss_of(batch, target, estimator, context)
    descend(state.optimizers["q"], loss, context.part)
    return loss.detach()
