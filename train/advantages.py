"""How much worse than the best the logged actions were, by the lagged network: what returns are corrected by.

Its trunk runs once for each state. Dimensions: B batch, T steps, A action, N candidates.
"""

import dataclasses
from typing import NamedTuple

import torch
from torch import Tensor

from graspq.common.options import setting
from graspq.train.augment import mirror_image
from graspq.train.batch import Batch
from graspq.train.estimator import LaggedSettings, RegressionSettings
from graspq.train.selection import uniform_actions
from graspq.train.state import Networks
from graspq.train.targets import corrected_episode_value, double_q


@dataclasses.dataclass(frozen=True)
class CorrectionSettings(LaggedSettings, RegressionSettings):
    """Options of estimators that correct a return by advantages."""

    candidates: int = setting(16, help="Uniform actions among which the best of a state is sought.", minimum=1)
    centred: bool = setting(
        True, help="Shift the advantages so that the targets of a batch agree with the lagged Q on average."
    )
    look_in_mirror: bool = setting(
        True, help="Let the online network pick the best action on the mirror image, where there is a mirror."
    )


class LaggedValues(NamedTuple):
    """What the lagged network says of a batch's later steps; float32 [B, T], NaN elsewhere."""

    value: Tensor
    q: Tensor


def lagged_values(
    batch: Batch, networks: Networks, settings: CorrectionSettings, random: torch.Generator
) -> LaggedValues:
    """Return V and Q of the later steps by the lagged network; both networks' trunks run once for each.

        V(s_t) = max(Q_θ'(s_t, a_t), Q_θ'(s_t, a*)),
        a* = argmax_{a ∈ {a_t, u₁ .. u_N}} Q_θ(M s_t, M a),  uᵢ ~ U[-1, 1]ᴬ,  M: mirror image, or none

    Args:
        batch: whole episodes.
        networks: θ in evaluation mode, θ'.
        settings: N, whether to look into the mirror.
        random: of the candidates; a step's draws are the same whichever steps are real.
    """
    value, q = torch.full_like(batch.reward, torch.nan), torch.full_like(batch.reward, torch.nan)
    later = batch.later_steps
    if bool(later.any()):
        image, step, logged = batch.image[later], batch.step[later], batch.action[later].unsqueeze(1)
        rows, steps, parts = batch.action.shape
        drawn = torch.stack([uniform_actions(random, rows, settings.candidates, parts) for _ in range(steps)], 1)
        candidates = torch.cat([logged, drawn.to(later.device)[later]], dim=1)
        mirror = networks.specification.action.mirror if settings.look_in_mirror else None
        seen = (image, candidates) if mirror is None else mirror_image(image, candidates, mirror)
        q_of_candidates = networks.q.at(seen[0], step)(seen[1])
        q_of_both = double_q(q_of_candidates, candidates, networks.lagged_q.at(image, step), beside=logged).float()
        q[later], value[later] = q_of_both[:, 0], q_of_both.amax(1)
    return LaggedValues(value, q)


def advantages(batch: Batch, values: LaggedValues, nu: float, settings: CorrectionSettings) -> Tensor:
    """Return how much worse than the best each logged action is; float32 [B, T], NaN but at later steps.

        A(s_t, a_t) = Q_θ'(s_t, a_t) - V(s_t) ≤ 0,  and where they are centred
        A(s_t, a_t) + c_t,  c_t = mean over the batch's episodes with a step t of  y_t - Q_θ'(s_t, a_t)

    Q_θ' of logged actions has the mean of its own targets wherever θ' is right, and c_t is 0 there. While it is not,
    all targets before would be raised by the same error. With c_t the targets of a batch are those of bootstrapping on
    average; what each episode had more or less than the others is counted as before.

    Args:
        batch: whole episodes.
        values: what θ' says of it.
        nu: ν.
        settings: γ, and whether they are centred.
    """
    advantage = values.q - values.value
    if not settings.centred:
        return advantage
    later, discount = batch.later_steps, settings.discount
    target = corrected_episode_value(batch.reward, advantage, nu, discount, batch.mask)
    error = torch.where(later, target - values.q, torch.zeros_like(target))
    return advantage + shifts(error.sum(0), later.sum(0).to(error.dtype), nu, discount)


def shifts(error: Tensor, episodes: Tensor, nu: float, discount: float) -> Tensor:
    """Return c_t by what the targets without any shift are off by.

        c_t = (E_t - ν γ w_{t+1}) / n_t,  w_t = n_t c_t + γ w_{t+1}

    Args:
        error: E_t, sum over episodes of y_t - Q_θ'(s_t, a_t); float [T].
        episodes: n_t, how many have a step t, each of which has all steps before; float [T].
        nu: ν.
        discount: γ.

    Returns:
        float [T]; meaningless where n_t is 0.
    """
    result, after = torch.zeros_like(error), torch.zeros_like(error[0])
    for t in reversed(range(len(error))):
        result[t] = (error[t] - nu * discount * after) / episodes[t].clamp(min=1)
        after = episodes[t] * result[t] + discount * after
    return result
