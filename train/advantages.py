"""Values of the later steps of logged paths, and how much worse than the best their actions were.

Each network's trunk runs once for each state. Dimensions: B batch, T steps, A action, N candidates.
"""

import dataclasses
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from graspq.common.options import setting
from graspq.train.batch import Batch
from graspq.train.estimator import LaggedSettings, RegressionSettings
from graspq.train.selection import uniform_actions
from graspq.train.state import Networks
from graspq.train.targets import corrected_episode_value, double_q
from graspq.train.views import mirror_image

Judge = Literal["online", "online-gradient", "lagged"]


@dataclasses.dataclass(frozen=True)
class CorrectionSettings(LaggedSettings, RegressionSettings):
    """Options of estimators that correct a return by advantages."""

    candidates: int = setting(16, help="Uniform actions among which the best of a state is sought.", minimum=1)
    judge: Judge = setting(
        "online",
        help="Whose Q of the logged action an advantage takes: the trained network's as a constant, the trained "
        "network's with its gradient, or the lagged network's.",
    )
    clamped: bool = setting(
        False, help="Let the logged action be a candidate and no advantage be above 0; biased upward."
    )
    centred: bool = setting(
        False, help="Shift the advantages so that a batch's targets agree with Q on average; no correction is left."
    )
    look_in_mirror: bool = setting(
        False, help="Let the online network see the mirror image where it picks and judges, where there is a mirror."
    )


class LaterValues(NamedTuple):
    """What the networks say of a batch's later steps; float32 [B, T], NaN elsewhere.

    `value` is V(s_t), `q` is Q(s_t, a_t) of the logged action.
    """

    value: Tensor
    q: Tensor


def values_by_double_q(batch: Batch, networks: Networks, candidates: int, random: torch.Generator) -> Tensor:
    """Return V of the later steps by double Q-learning; float32 [B, T], NaN elsewhere.

        V(s_t) = Q_θ'(s_t, argmax_{a ∈ {u₁ .. u_N}} Q_θ(s_t, a)),  uᵢ ~ U[-1, 1]ᴬ

    Args:
        batch: whole episodes.
        networks: θ in evaluation mode, θ'.
        candidates: N.
        random: of the candidates; a step's draws are the same whichever steps are real.
    """
    value, later = torch.full_like(batch.reward, torch.nan), batch.later_steps
    if bool(later.any()):
        image, step, drawn = batch.image[later], batch.step[later], _drawn(batch, candidates, random)
        value[later] = double_q(networks.q.at(image, step)(drawn), drawn, networks.lagged_q.at(image, step))[
            :, 0
        ].float()
    return value


def later_values(
    batch: Batch, networks: Networks, settings: CorrectionSettings, random: torch.Generator
) -> LaterValues:
    """Return V and Q of the logged action at the later steps.

        V(s_t) = Q_θ'(s_t, a*),  a* = argmax_{a ∈ {u₁ .. u_N}} Q_θ(M s_t, M a),  uᵢ ~ U[-1, 1]ᴬ
        Q(s_t, a_t) = Q_θ(M s_t, M a_t), or Q_θ'(s_t, a_t) where the lagged network judges

    M is the mirror image, or none. Where advantages are clamped, a_t is among the candidates, and V is the larger of
    Q_θ'(s_t, a*) and Q(s_t, a_t).

    Args:
        batch: whole episodes.
        networks: θ in evaluation mode, θ'.
        settings: N, who judges, whether to look into the mirror, whether to clamp.
        random: of the candidates; a step's draws are the same whichever steps are real.
    """
    value, q = torch.full_like(batch.reward, torch.nan), torch.full_like(batch.reward, torch.nan)
    later = batch.later_steps
    if bool(later.any()):
        image, step, logged = batch.image[later], batch.step[later], batch.action[later].unsqueeze(1)
        actions = torch.cat([logged, _drawn(batch, settings.candidates, random)], dim=1)
        mirror = networks.specification.action.mirror if settings.look_in_mirror else None
        seen = (image, actions) if mirror is None else mirror_image(image, actions, mirror)
        online = networks.q.at(seen[0], step)(seen[1]).float()
        first = 0 if settings.clamped else 1
        judge = networks.lagged_q.at(image, step)
        lagged = double_q(online[:, first:], actions[:, first:], judge, beside=logged).float()
        q[later] = lagged[:, 0] if settings.judge == "lagged" else online[:, 0]
        value[later] = torch.maximum(lagged[:, 1], q[later]) if settings.clamped else lagged[:, 1]
    return LaterValues(value, q)


def _drawn(batch: Batch, candidates: int, random: torch.Generator) -> Tensor:
    """Return the candidates of the later steps, float32 [n, N, A]."""
    rows, steps, parts = batch.action.shape
    drawn = torch.stack([uniform_actions(random, rows, candidates, parts) for _ in range(steps)], 1)
    return drawn.to(batch.action.device)[batch.later_steps]


def advantages(batch: Batch, values: LaterValues, nu: float, settings: CorrectionSettings) -> Tensor:
    """Return how much worse than the best each logged action is; float32 [B, T], NaN but at later steps.

        A(s_t, a_t) = Q(s_t, a_t) - V(s_t),  and where they are centred
        A(s_t, a_t) + c_t,  c_t = mean over the batch's episodes with a step t of  y_t - Q(s_t, a_t)

    With c_t the targets of a batch are those of bootstrapping on average: only what each episode had more or less than
    the others is counted as before.

    Args:
        batch: whole episodes.
        values: of its later steps; gradients flow through them, but not through c_t.
        nu: ν.
        settings: γ, and whether they are centred.
    """
    advantage = values.q - values.value
    if not settings.centred:
        return advantage
    later, discount = batch.later_steps, settings.discount
    target = corrected_episode_value(batch.reward, advantage.detach(), nu, discount, batch.mask)
    error = torch.where(later, target - values.q.detach(), torch.zeros_like(target))
    return advantage + shifts(error.sum(0), later.sum(0).to(error.dtype), nu, discount)


def shifts(error: Tensor, episodes: Tensor, nu: float, discount: float) -> Tensor:
    """Return c_t by what the targets without any shift are off by.

        c_t = (E_t - ν γ w_{t+1}) / n_t,  w_t = n_t c_t + γ w_{t+1}

    Args:
        error: E_t, sum over episodes of y_t - Q(s_t, a_t); float [T].
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
