"""`corr-mc`: the return that the episode really had, plus what its later actions were worse than the best ones by.

Advantages come from the lagged network, whose trunk runs once for each state. Dimensions: B batch, T steps, A action,
N candidates.

Differs:
1. V(s) is the lagged network's Q of the best of N uniform actions and the logged one, or that of the logged one where
   this is larger. Thus no advantage is above 0, as none of the true ones is,
   before they are centred (3). As in the released code θ picks the best
   and θ' judges it; here θ picks on the mirror image of the state (unless `--no-mirror`), where its errors are others.
   A maximum over 17 independent values with deviation σ is too high by 1.79 σ; picked by another network, by 0.53 σ.
2. Advantages are constants of the loss; the released code lets gradient through them.
3. Advantages are centred (`--centred`, off with `--preset paper`); see `centred_advantage`.
4. The lagged network is copied every `--lag-steps` 50 steps as for `dql`, every 100 in the released code and with
   `--preset paper`.
5. ν rises over the part `--anneal` of the training: over all of it, by default; over a twentieth with `--preset paper`,
   which is the released code's 100,000 of 2 million steps. The paper's text says "during training".
6. A batch holds so many whole episodes that it has `--batch-size` transitions on average, also with `--preset paper`;
   in the released code 32 counts episodes.
7. The learning rate is that of all estimators; the released code's is 1e-4 for this one (`--preset paper`).

Why 1, 3 and 5: where waiting costs no more than the discount, a V that is too high by δ at every step comes back as
γ δ / (1 - γ), nine times as much, in Q of waiting; and the policy waits until T. Measured with `mc`'s recipe on 10,000
grasps, 3,000 steps; w is the mean Q of going up at the steps from 3 on, where the best way down has Q 0.77:

    θ' picks and judges, not centred, ν over half of the training        success 0.002 of 500   w 0.90
    the same, ν over a twentieth    (targets above 1 on average; loss 262 at step 1,800)  0.06 of 100
    the same, 1,500 steps, θ picks; on the mirror image                  0 of 200; 0 of 200
    θ' picks and judges, centred, ν over half                            0 of 100               w 0.74
    θ picks on the mirror image, centred, ν over half                    0.45 of 100            w 0.68
    the same, ν over all of the training                                 0.862 of 500           w 0.56
"""

from typing import NamedTuple

import torch
from torch import Tensor

from graspq.train.augment import mirror_image
from graspq.train.batch import Batch
from graspq.train.state import Context
from graspq.train.targets import corrected_episode_value


def corrected_target(batch: Batch, context: Context) -> Tensor:
    """Return the observed return minus ν times the later advantages; see `targets.corrected_episode_value`; [B, T].

    Source: Quillen et al. 2018, section "Corrected Monte Carlo Evaluation".
    Differs: see the list of the module.
    """
    nu = annealed(context.progress, context.anneal)
    advantage = advantages(batch, judged(batch, context), nu, context)
    return corrected_episode_value(batch.reward, advantage, nu, context.discount, batch.mask)


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


def judged(batch: Batch, context: Context) -> Judged:
    """Return V and Q of the later steps by the lagged network; both networks' trunks run once for each.

        V(s_t) = max(Q_θ'(s_t, a_t), Q_θ'(s_t, a*)),
        a* = argmax_{a ∈ {a_t, u₁ .. u_N}} Q_θ(M s_t, M a),  uᵢ ~ U[-1, 1]ᴬ,  M: mirror image, or none

    Args:
        batch: whole episodes.
        context: gives θ in evaluation mode, θ', N, whether there is a mirror, and the random numbers.
    """
    value, q = torch.full_like(batch.reward, torch.nan), torch.full_like(batch.reward, torch.nan)
    later = later_steps(batch)
    if bool(later.any()):
        image, step, logged = batch.image[later], batch.step[later], batch.action[later].unsqueeze(1)
        candidates = torch.cat([logged, context.candidate_actions(later, logged.shape[-1])], dim=1)
        seen_image, seen = mirror_image(image, candidates) if context.mirror else (image, candidates)
        picked = context.network.at(seen_image, step)(seen).argmax(1, keepdim=True)
        both = torch.cat([logged, candidates.take_along_dim(picked.unsqueeze(2), 1)], dim=1)
        q_of_both = context.lagged.at(image, step)(both).float()
        q[later], value[later] = q_of_both[:, 0], q_of_both.amax(1)
    return Judged(value, q)


def advantages(batch: Batch, seen: Judged, nu: float, context: Context) -> Tensor:
    """Return how much worse than the best each logged action is; float32 [B, T], NaN but at later steps.

    A(s_t, a_t) = Q_θ'(s_t, a_t) - V(s_t) ≤ 0,  or this centred, where the context says so
    """
    return centred_advantage(batch, seen, nu, context) if context.centred else seen.advantage


def centred_advantage(batch: Batch, seen: Judged, nu: float, context: Context) -> Tensor:
    """Return advantages that are shifted, step by step, so that the targets agree with θ' on average.

        A(s_t, a_t) + c_t,  c_t = mean over the batch's episodes with a step t of  y_t - Q_θ'(s_t, a_t)

    Q_θ' of logged actions has the mean of its own targets wherever θ' is right, and c_t is 0 there. While it is not,
    because it lags behind targets that rise with ν or because its logits end at 1, all targets before would be raised
    by the same error, and θ' would lag even more. With c_t the targets of a batch are those of bootstrapping on
    average; what each episode had more or less than the others is counted as before.

    Args:
        batch: whole episodes.
        seen: what θ' says of it.
        nu: ν.
        context: gives γ, and the other parts of the batch where ranks share it.
    """
    later = later_steps(batch)
    target = corrected_episode_value(batch.reward, seen.advantage, nu, context.discount, batch.mask)
    error = torch.where(later, target - seen.q, torch.zeros_like(target))
    total = context.part.sum_by_step(torch.stack([error.sum(0), later.sum(0).to(error.dtype)]))
    return seen.advantage + shifts(total[0], total[1], nu, context.discount)[: later.shape[1]]


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
