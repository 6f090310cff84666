"""The paper's target values as pure functions of tensors: what each estimator regresses Q(s_t, a_t) onto.

No network stands here: whatever a target needs of one is an argument. All take and return float [B, T], one row an
episode from its first to its last step; a batch of single transitions is T = 1. Dimensions: B batch, T steps.
"""

import torch
from torch import Tensor


def discounted_return(reward: Tensor, discount: float, mask: Tensor | None = None) -> Tensor:
    """Return the discounted sum of the rewards from each step to the last one.

        R_t = Σ_{t'=t}^{T} γ^{t'-t} r_t',  by the recursion  R_t = r_t + γ R_{t+1},  R_{T+1} = 0

    Args:
        reward: float [B, T], whole episodes.
        discount: γ in [0, 1].
        mask: bool [B, T], false where an episode has already ended; rewards there are not read and the result is 0.

    Returns:
        float [B, T].

    Source: Quillen et al. 2018, section "Regression with Monte Carlo Return Estimates".
    """
    _check_shapes(reward, mask)
    kept = reward if mask is None else torch.where(mask, reward, torch.zeros_like(reward))
    result = torch.zeros_like(kept)
    following = torch.zeros_like(kept[:, 0])
    for t in reversed(range(kept.shape[1])):
        following = kept[:, t] + discount * following
        result[:, t] = following
    return result if mask is None else torch.where(mask, result, torch.zeros_like(result))


def episode_value(observed_return: Tensor) -> Tensor:
    """Return the target of Monte-Carlo evaluation: the return that was observed from this step on.

        y_t = R_t

    Args:
        observed_return: float [B, T], the dataset's label `mc_return` or `discounted_return` of the rewards.

    Returns:
        float [B, T].

    Source: Quillen et al. 2018, section "Regression with Monte Carlo Return Estimates" and the table of section
    "Summary and Unified View". Its footnote says that Monte Carlo and supervised learning use no discount.
    """
    return observed_return


def bootstrapped(reward: Tensor, terminal: Tensor, next_value: Tensor, discount: float) -> Tensor:
    """Return the Bellman target.

        y_t = r_t + γ V(s_{t+1})  before the last step,  y_T = r_T  at it

    With double Q-learning V(s') = Q_θ'(s', argmax_a' Q_θ(s', a')): θ picks, the lagged θ' judges.

    Args:
        reward: float [B, T].
        terminal: bool [B, T], true at the last step of an episode, where `next_value` is not read (it may be NaN).
        next_value: V(s_{t+1}), float [B, T].
        discount: γ in [0, 1].

    Returns:
        float [B, T].

    Source: Quillen et al. 2018, section "Off-Policy Q-Learning".
    """
    _check_shapes(reward, terminal, next_value)
    return reward + discount * torch.where(terminal, torch.zeros_like(next_value), next_value)


def _check_shapes(reference: Tensor, *others: Tensor | None) -> None:
    for other in (reference, *others):
        if other is not None and (other.dim() != 2 or other.shape != reference.shape):
            raise ValueError(
                f"expected tensors of one shape [B, T], got {list(reference.shape)} and {list(other.shape)}"
            )
