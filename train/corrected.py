"""`corr-mc`: the return that the episode really had, plus what its later actions were worse than the best ones by.

Advantages come from the lagged network, whose trunk runs once for each state. Dimensions: B batch, T steps, A action,
N candidates.

Differs:
1. V(s) is the lagged network's maximum over N uniform actions and the logged one. Thus no advantage is above 0, as none
   of the true ones is; with uniform actions alone a good logged action has an advantage above 0. The released code lets
   the network pick and the lagged one judge (double Q).
2. Advantages are constants of the loss; the released code lets gradient through them.
3. The lagged network is copied every `--lag-steps` 50 steps as for `dql`, every 100 in the released code.
4. ν rises over the part `--anneal` of the training: half, by default; 0.05 with `--preset paper`, which is the released
   code's 100,000 of 2 million steps. The paper does not say.
5. A maximum over noisy values is too high on average: over 17 independent values with deviation σ by 1.79 σ. Noise of a
   network is not independent between near actions, so this bounds it; `dql` judges with another network instead.
6. A batch holds so many whole episodes that it has `--batch-size` transitions on average.
7. The learning rate is that of all estimators; the released code's is 1e-4 for this one alone.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from graspq.train.batch import Batch
from graspq.train.state import Context
from graspq.train.targets import corrected_episode_value


def corrected_target(batch: Batch, context: Context) -> Tensor:
    """Return the observed return minus ν times the later advantages; see `targets.corrected_episode_value`; [B, T].

    Source: Quillen et al. 2018, section "Corrected Monte Carlo Evaluation".
    Differs: see the list of the module.
    """
    nu = annealed(context.progress, context.anneal)
    return corrected_episode_value(batch.reward, sampled_advantage(batch, context), nu, context.discount, batch.mask)


def annealed(progress: float, part: float) -> float:
    """Return ν = min(progress / part, 1): from 0 to 1 over the first `part` of the training; 1 where that is 0."""
    return min(progress / part, 1.0) if part > 0 else 1.0


def sampled_advantage(batch: Batch, context: Context) -> Tensor:
    """Return how much worse than the best candidate each logged action is, by the lagged network; see `judged`.

        A(s_t, a_t) = Q_θ'(s_t, a_t) - V(s_t) ≤ 0

    Returns:
        float32 [B, T]; NaN at first steps, whose advantage no target reads, and on padding.
    """
    seen = judged(batch, context)
    return seen.q - seen.value


class Judged(NamedTuple):
    """What the lagged network says of a batch's later steps; float32 [B, T], NaN elsewhere."""

    value: Tensor
    q: Tensor


def judged(batch: Batch, context: Context) -> Judged:
    """Return V and Q of the later steps by the lagged network, whose trunk runs once for each.

        V(s_t) = max_{a ∈ {a_t, u₁ .. u_N}} Q_θ'(s_t, a),  uᵢ ~ U[-1, 1]ᴬ

    Args:
        batch: whole episodes.
        context: gives θ', N and the random numbers.
    """
    value, q = torch.full_like(batch.reward, torch.nan), torch.full_like(batch.reward, torch.nan)
    later = later_steps(batch)
    if bool(later.any()):
        q_of_actions = context.lagged.at(batch.image[later], batch.step[later])
        logged = batch.action[later].unsqueeze(1)
        drawn = context.candidate_actions(later, logged.shape[-1])
        candidates = q_of_actions(torch.cat([logged, drawn], dim=1)).float()
        q[later], value[later] = candidates[:, 0], candidates.amax(1)
    return Judged(value, q)


def later_steps(batch: Batch) -> Tensor:
    """Return which steps are real and not the first of their episode; bool [B, T]."""
    later = torch.ones_like(batch.terminal) if batch.mask is None else batch.mask.clone()
    later[:, 0] = False
    return later
