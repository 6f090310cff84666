"""`corr-mc`: the return that the episode really had, plus what its later actions were worse than the best ones by.

Advantages come from the lagged network, whose trunk runs once for each state. Dimensions: B batch, T steps, A action,
N candidates. Measurements and why it departs from the paper: docs/estimators/corr-mc.md.
"""

import dataclasses
from typing import NamedTuple

import torch
from torch import Tensor

from graspq.common.options import setting
from graspq.train.acting import StochasticSearch
from graspq.train.augment import mirror_image
from graspq.train.batch import Batch
from graspq.train.estimator import Estimator, LaggedSettings, TargetValue
from graspq.train.recipe import PAPER
from graspq.train.selection import uniform_actions
from graspq.train.state import Networks
from graspq.train.targets import corrected_episode_value, double_q


@dataclasses.dataclass(frozen=True)
class CorrectionSettings(LaggedSettings):
    """Options of estimators that correct a return by advantages."""

    candidates: int = setting(16, help="Uniform actions among which the best of a state is sought.", minimum=1)
    centred: bool = setting(
        True, help="Shift the advantages so that the targets of a batch agree with the lagged Q on average."
    )
    look_in_mirror: bool = setting(
        True, help="Let the online network pick the best action on the mirror image, where there is a mirror."
    )


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
    advantage = advantages(batch, judged(batch, networks, settings, random), nu, settings)
    return corrected_episode_value(batch.reward, advantage, nu, settings.discount, batch.mask)


def annealed(progress: float, part: float) -> float:
    """Return ν = min(progress / part, 1): from 0 to 1 over the first `part` of the training; 1 where that is 0."""
    return min(progress / part, 1.0) if part > 0 else 1.0


class Judged(NamedTuple):
    """What the lagged network says of a batch's later steps; float32 [B, T], NaN elsewhere."""

    value: Tensor
    q: Tensor

    @property
    def advantage(self) -> Tensor:
        """A(s_t, a_t) = Q_θ'(s_t, a_t) - V(s_t) ≤ 0."""
        return self.q - self.value


def judged(batch: Batch, networks: Networks, settings: CorrectionSettings, random: torch.Generator) -> Judged:
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
    later = later_steps(batch)
    if bool(later.any()):
        image, step, logged = batch.image[later], batch.step[later], batch.action[later].unsqueeze(1)
        rows, steps, parts = batch.action.shape
        drawn = torch.stack([uniform_actions(random, rows, settings.candidates, parts) for _ in range(steps)], 1)
        candidates = torch.cat([logged, drawn.to(later.device)[later]], dim=1)
        mirror = networks.specification.action.mirror if settings.look_in_mirror else None
        seen_image, seen = (image, candidates) if mirror is None else mirror_image(image, candidates, mirror)
        q_of_seen, judge = networks.q.at(seen_image, step)(seen), networks.lagged_q.at(image, step)
        q_of_both = double_q(q_of_seen, candidates, judge, beside=logged).float()
        q[later], value[later] = q_of_both[:, 0], q_of_both.amax(1)
    return Judged(value, q)


def advantages(batch: Batch, seen: Judged, nu: float, settings: CorrectionSettings) -> Tensor:
    """Return how much worse than the best each logged action is; float32 [B, T], NaN but at later steps.

    A(s_t, a_t) = Q_θ'(s_t, a_t) - V(s_t) ≤ 0,  or this centred, where the settings say so
    """
    return centred_advantage(batch, seen, nu, settings.discount) if settings.centred else seen.advantage


def centred_advantage(batch: Batch, seen: Judged, nu: float, discount: float) -> Tensor:
    """Return advantages that are shifted, step by step, so that the targets agree with θ' on average.

        A(s_t, a_t) + c_t,  c_t = mean over the batch's episodes with a step t of  y_t - Q_θ'(s_t, a_t)

    Q_θ' of logged actions has the mean of its own targets wherever θ' is right, and c_t is 0 there. While it is not,
    all targets before would be raised by the same error. With c_t the targets of a batch are those of bootstrapping on
    average; what each episode had more or less than the others is counted as before.

    Args:
        batch: whole episodes.
        seen: what θ' says of it.
        nu: ν.
        discount: γ.
    """
    later = later_steps(batch)
    target = corrected_episode_value(batch.reward, seen.advantage, nu, discount, batch.mask)
    error = torch.where(later, target - seen.q, torch.zeros_like(target))
    return seen.advantage + shifts(error.sum(0), later.sum(0).to(error.dtype), nu, discount)


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


def later_steps(batch: Batch) -> Tensor:
    """Return which steps are real and not the first of their episode; bool [B, T]."""
    later = torch.ones_like(batch.terminal) if batch.mask is None else batch.mask.clone()
    later[:, 0] = False
    return later


ROW = Estimator(
    summary="Monte-Carlo returns, corrected by how much worse than the best the later actions were",
    settings=CorrMcSettings,
    target_value=TargetValue("corrected episode value, coefficient nu annealed 0 -> 1", target, view="episodes"),
    action_selection=StochasticSearch(),
    paper=CorrMcSettings(loss="squared", lag_steps=100, anneal=0.05, centred=False, look_in_mirror=False),
    paper_recipe=dataclasses.replace(PAPER, learning_rate=1e-4),
)
