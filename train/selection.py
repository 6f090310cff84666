"""The two ways to pick an action: stochastic search (uniform draws, the cross-entropy method) and an actor network.

Searches are pure functions of a Q-function of actions and of random numbers that the caller draws, so that one state's
choice does not depend on which other states share its batch. Dimensions: B batch, N candidates, A action, I iterations.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from graspq.common.action_space import ActionSpace
from graspq.train.search_settings import Answer

QOfActions = Callable[[Tensor], Tensor]
"""Q of candidate actions, [B, N, A] -> [B, N], for B states that are fixed inside it."""
# How far outside the box an actor may point.
FARTHEST_POINT = 1.25


class Choice(NamedTuple):
    """The best action found for each state, and its Q.

    `action` is float [B, A] in units of the action limits, inside what was searched; `q` is float [B], on the scale of
    the Q-function that was searched.
    """

    action: Tensor
    q: Tensor


class SearchSpace(NamedTuple):
    """Where a search starts, and the box that it does not leave; each float [B, A] or [1, A].

    `mean` and `deviation` are those of the first draws, `low` and `high` the bounds, in units of the action limits.
    """

    mean: Tensor
    deviation: Tensor
    low: Tensor
    high: Tensor


def single_steps(action: ActionSpace, near: Tensor) -> SearchSpace:
    """Return the space of one step's actions, [-1, 1]ᴬ from where the action space says; type and device of `near`."""
    mean = torch.tensor([action.start], device=near.device, dtype=near.dtype)
    return SearchSpace(
        mean, torch.full_like(mean, action.deviation), torch.full_like(mean, -1), torch.full_like(mean, 1)
    )


def uniform_actions(generator: torch.Generator, batch: int, candidates: int, dimensions: int) -> Tensor:
    """Draw candidate actions aᵢ ~ U[-1, 1]ᴬ on the generator's device; float32 [B, N, A]."""
    draws = torch.rand(batch, candidates, dimensions, generator=generator, device=generator.device)
    return draws * 2 - 1


def best_of(candidates: Tensor, q: Tensor) -> Choice:
    """Return the candidate of highest Q in each state, the first of equals: a* = argmaxᵢ Q(s, aᵢ).

    Args:
        candidates: float [B, N, A].
        q: theirs, float [B, N].

    Source: Quillen et al. 2018, section "Off-Policy Q-Learning" (the best of 16 uniform actions).
    """
    index = q.argmax(dim=1)
    rows = torch.arange(len(index), device=index.device)
    return Choice(candidates[rows, index], q[rows, index])


def cross_entropy_method(
    q_of_actions: QOfActions,
    noise: Tensor,
    space: SearchSpace,
    *,
    elites: int = 10,
    answer: Answer = "mean",
) -> Choice:
    """Return the action that the cross-entropy method ends at.

        first iteration:   aᵢ = clip(μ₀ + σ₀ εᵢ, low, high)
        later iterations:  aᵢ = clip(μ + σ εᵢ, low, high),  μ, σ = mean and standard deviation (n - 1) of the elites
        answer:            μ of the last iteration's elites ("mean"), or the best of all samples ("best"), or of that
                           iteration's ("last")

    Args:
        q_of_actions: Q-function of candidates.
        noise: standard normal numbers, float [I, B, N, A]; its shape says how many iterations and samples there are.
        space: μ₀, σ₀, low and high.
        elites: how many of the N samples a normal distribution is fitted to, 2 to N.
        answer: see above. Where Q is learned the mean is the better action: the best sample is often a false peak.

    Returns:
        The action and its Q.

    Raises:
        ValueError: `noise` has not four dimensions or `elites` is not between 2 and N.

    Source: Quillen et al. 2018, section "Learning to Grasp with Supervised Learning" (3 iterations, 64 samples).
    Start and number of elites are the released code's. Where the search starts matters: see docs/estimators/dql.md.
    Differs: the released code does not clip; its answer is "last".
    """
    if noise.dim() != 4 or not 2 <= elites <= noise.shape[2]:
        raise ValueError(
            f"expected noise [iterations, batch, samples, action] and 2 to {noise.shape[-2]} elites, "
            f"got noise {list(noise.shape)} and {elites} elites"
        )
    start, spread, low, high = (bound.unsqueeze(1) for bound in space)
    candidates = (start + spread * noise[0]).clamp(low, high)
    q = q_of_actions(candidates)
    best = best_of(candidates, q)
    for epsilon in noise[1:]:
        deviation, mean = _elite_moments(candidates, q, elites)
        candidates = (mean + deviation * epsilon).clamp(low, high)
        q = q_of_actions(candidates)
        best = _better(best, best_of(candidates, q))
    if answer == "best":
        return best
    if answer == "last":
        return best_of(candidates, q)
    _, mean = _elite_moments(candidates, q, elites)
    return Choice(mean.squeeze(1), q_of_actions(mean).squeeze(1))


def pointed(output: Tensor, action: ActionSpace) -> Tensor:
    """Return where an actor network points: its action, but for the clipping to [-1, 1].

        direction = c f(output + f⁻¹(start / c)),  f(x) = x / √(1 + x²),  c = 1.25

    An output of 0 is the start of a search. Where many logged actions lie at a bound, a function that ended there would
    get to them at infinity only; f, because the gradient of tanh dies so fast that an actor which overshot into a
    corner never came back.

    Args:
        output: raw outputs of a state network, float [..., A].
        action: says where a search starts.

    Returns:
        float32 [..., A] in (-1.25, 1.25); clip it to act.

    Source: the released code's actor is linear and unbounded.
    """
    start = torch.tensor(action.start, device=output.device) / FARTHEST_POINT
    shifted = output.float() + start * torch.rsqrt(1 - start.square())
    return FARTHEST_POINT * shifted * torch.rsqrt(1 + shifted.square())


def _elite_moments(candidates: Tensor, q: Tensor, elites: int) -> tuple[Tensor, Tensor]:
    """Return standard deviation and mean, [B, 1, A] each, of the `elites` candidates of highest Q."""
    chosen = q.topk(elites, dim=1).indices
    elite = candidates.gather(1, chosen.unsqueeze(-1).expand(-1, -1, candidates.shape[-1]))
    deviation, mean = torch.std_mean(elite, dim=1, keepdim=True)
    return deviation, mean


def _better(first: Choice, second: Choice) -> Choice:
    improved = second.q > first.q
    return Choice(
        torch.where(improved.unsqueeze(-1), second.action, first.action), torch.where(improved, second.q, first.q)
    )
