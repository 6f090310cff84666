"""The paper's target values as pure functions of tensors: what each estimator regresses Q(s_t, a_t) onto.

No network stands here: whatever a target needs of one is an argument. All take and return float [B, T], one row an
episode from its first to its last step; a batch of single transitions is T = 1. Dimensions: B batch, T steps.
"""

import torch
from torch import Tensor

from graspq.train.selection import QOfActions, best_of


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
    kept = _real(reward, mask)
    result = torch.zeros_like(kept)
    following = torch.zeros_like(kept[:, 0])
    for t in reversed(range(kept.shape[1])):
        following = kept[:, t] + discount * following
        result[:, t] = following
    return _real(result, mask)


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

    With double Q-learning V is that of `double_q`.

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


def double_q(q: Tensor, candidates: Tensor, judge: QOfActions, beside: Tensor | None = None) -> Tensor:
    """Return V(s) of double Q-learning: θ picks the best candidate, the lagged θ' judges it.

        V(s) = Q_θ'(s, argmax_{a ∈ {a₁ .. a_N}} Q_θ(s, a))

    Args:
        q: Q_θ of the candidates, float [B, N]; B are the states.
        candidates: float [B, N, A].
        judge: Q_θ' of actions; asked once.
        beside: further actions that θ' judges, float [B, M, A].

    Returns:
        float [B, M + 1]: Q_θ' of the M actions, then V(s).

    Source: van Hasselt et al. 2016, "Deep Reinforcement Learning with Double Q-learning", equation 4, over candidates;
    Quillen et al. 2018, section "Off-Policy Q-Learning" (16 uniform ones).
    """
    picked = best_of(candidates, q).action.unsqueeze(1)
    return judge(picked if beside is None else torch.cat([beside, picked], dim=1))


def n_step(
    reward: Tensor, value: Tensor, discount: float, steps: int | None = None, mask: Tensor | None = None
) -> Tensor:
    """Return the rewards of the next n steps and the value of the state after them.

        y_t = Σ_{i=0}^{n-1} γⁱ r_{t+i} + γⁿ V(s_{t+n}),  V = r = 0 after the end

    With n = 1 this is the bootstrapped target, with n ≥ T the observed return.

    Args:
        reward: float [B, T], whole episodes.
        value: V(s_t), float [B, T]; that of the first step is not read (it may be NaN).
        discount: γ in [0, 1].
        steps: n, at least 1; None is the rest of the episode.
        mask: bool [B, T], false where an episode has already ended; nothing is read there and the result is 0.

    Returns:
        float [B, T].

    Source: Sutton and Barto 2018, equation 7.1; none in Quillen et al. 2018.
    """
    _check_shapes(reward, value, mask)
    to_the_end = discounted_return(reward, discount, mask)
    if steps is None or steps >= reward.shape[1]:
        return to_the_end
    after = torch.zeros_like(to_the_end)
    after[:, :-steps] = (_real(value, mask) - to_the_end)[:, steps:]
    return to_the_end + discount**steps * after


def lambda_return(
    reward: Tensor, value: Tensor, trace_decay: float, discount: float, mask: Tensor | None = None
) -> Tensor:
    """Return the mean of the n-step targets with weights (1 - λ) λ^{n-1}, and what is left of them on the return.

        y_t = r_t + γ [(1 - λ) V(s_{t+1}) + λ y_{t+1}],  y_T = r_T

    With λ = 0 this is the bootstrapped target, with λ = 1 the observed return.

    Args:
        reward: float [B, T], whole episodes.
        value: V(s_t), float [B, T]; that of the first step is not read (it may be NaN).
        trace_decay: λ in [0, 1].
        discount: γ in [0, 1].
        mask: bool [B, T], false where an episode has already ended; nothing is read there and the result is 0.

    Returns:
        float [B, T].

    Source: Sutton and Barto 2018, equation 12.2; none in Quillen et al. 2018.
    """
    _check_shapes(reward, value, mask)
    kept, worth = _real(reward, mask), _real(value, mask)
    result = torch.zeros_like(kept)
    following = torch.zeros_like(kept[:, 0])
    for t in reversed(range(kept.shape[1])):
        result[:, t] = kept[:, t] + discount * following
        following = (1 - trace_decay) * worth[:, t] + trace_decay * result[:, t]
    return _real(result, mask)


def floored(observed_return: Tensor, target: Tensor) -> Tensor:
    """Return targets, but nowhere less than the return that was observed.

        max(R_t, y_t)

    In a process without chance a return is never above Q*, and the floor can only mend what bootstrapping has not yet
    carried back. Where outcomes are chance, its mean is too high: E max ≥ max E.

    Args:
        observed_return: R_t with the targets' discount, float [B, T].
        target: y_t, float [B, T].

    Returns:
        float [B, T].

    Source: Wilcox et al. 2022, "Monte Carlo Augmented Actor-Critic"; none in Quillen et al. 2018.
    """
    _check_shapes(observed_return, target)
    return torch.maximum(observed_return, target)


def corrected_episode_value(
    reward: Tensor, advantage: Tensor, nu: float, discount: float, mask: Tensor | None = None
) -> Tensor:
    """Return the observed return, corrected for every later action that was not the best.

        y_t = Σ_{t'=t}^{T} γ^{t'-t} r_t' - ν Σ_{t'=t+1}^{T} γ^{t'-t} A(s_t', a_t'),
        by the recursion  y_t = r_t + γ (y_{t+1} - ν A_{t+1}),  y_{T+1} = A_{T+1} = 0

    With ν = 1 and A = Q - V of the best policy its mean is that policy's Q; with ν = 0 it is the observed return. That
    exact A is never above 0, so its correction can only raise the target, with rewards of at most 1 above 1; an
    estimate of it may do either. Targets must not be clipped: the mean of clipped targets is not the clipped mean.

    Args:
        reward: float [B, T], whole episodes.
        advantage: A(s_t, a_t), float [B, T]; that of the first step is not read (it may be NaN).
        nu: coefficient ν of the correction, in [0, 1].
        discount: γ in [0, 1].
        mask: bool [B, T], false where an episode has already ended; nothing is read there and the result is 0.

    Returns:
        float [B, T].

    Source: Quillen et al. 2018, section "Corrected Monte Carlo Evaluation", last equation.
    """
    _check_shapes(reward, advantage, mask)
    nothing = torch.zeros_like(advantage[:, :1])
    later = torch.cat([advantage[:, 1:], nothing], dim=1)
    later_mask = None if mask is None else torch.cat([mask[:, 1:], nothing.bool()], dim=1)
    correction = discount * discounted_return(later, discount, later_mask)
    return discounted_return(reward, discount, mask) - nu * correction


def path_consistent(
    reward: Tensor,
    value: Tensor,
    log_ratio: Tensor,
    penalty: Tensor | float,
    discount: float,
    path_steps: int | None = None,
    mask: Tensor | None = None,
) -> Tensor:
    """Return what Trust-PCL wants V(s_t) to be: the return less the penalties along the logged path, and V after it.

        y_t = γᵈ V(s_{t+d}) + Σ_{i=0}^{d-1} γⁱ (r_{t+i} - λ ρ_{t+i}),  ρ = log π(a|s) - log π'(a|s),
        V = r = ρ = 0 after the end

    The n-step target of rewards less λ ρ: the corrected episode value with λ ρ for the advantage, which also counts at
    the first step, for V is wanted here, not Q. Gradients flow through `value` and `log_ratio`.

    Args:
        reward: float [B, T], whole episodes.
        value: V(s_t), float [B, T].
        log_ratio: ρ_t, float [B, T].
        penalty: λ, at least 0; a scalar.
        discount: γ in [0, 1].
        path_steps: d, at least 1; None is the rest of the episode.
        mask: bool [B, T], false where an episode has already ended; nothing is read there and the result is 0.

    Returns:
        float [B, T].

    Source: Quillen et al. 2018, section "Path Consistency Learning"; Nachum et al. 2018, "Trust-PCL", equation 15.
    """
    _check_shapes(reward, log_ratio)
    return n_step(reward - penalty * log_ratio, value, discount, path_steps, mask)


def blended(
    reward: Tensor, value: Tensor, advantage: Tensor, weight: Tensor, discount: float, mask: Tensor | None = None
) -> Tensor:
    """Return targets between the bootstrapped and the corrected episode value.

        y_t = r_t + γ [(1 - λ_{t+1}) V(s_{t+1}) + λ_{t+1} (y_{t+1} - A(s_{t+1}, a_{t+1}))],  y_T = r_T

    With λ = 0 this is the bootstrapped target, with λ = 1 the corrected episode value with ν = 1; with A = 0 and one λ
    for all it is the return of TD(λ), between the bootstrapped target and the observed return.

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
        result[:, t] = y
        mixed = (1 - weight[:, t]) * value[:, t] + weight[:, t] * (y - advantage[:, t])
        following = torch.where(real[:, t], mixed, torch.zeros_like(mixed))
    return _real(result, mask)


def _real(values: Tensor, mask: Tensor | None) -> Tensor:
    """Return values, [B, T], with 0 on padding whatever stands there."""
    return values if mask is None else torch.where(mask, values, torch.zeros_like(values))


def _check_shapes(reference: Tensor, *others: Tensor | None) -> None:
    for other in (reference, *others):
        if other is not None and (other.dim() != 2 or other.shape != reference.shape):
            raise ValueError(
                f"expected tensors of one shape [B, T], got {list(reference.shape)} and {list(other.shape)}"
            )
