"""Labels that are functions of an episode: the Monte-Carlo return and the synthetic action.

They are stored beside the steps for training to read, and recomputed by `verify`. T steps, A parts of an action.
"""

from collections.abc import Sequence

import numpy as np

from graspq.datasets.episode import Float32


def mc_return(rewards: Float32, discount: float) -> Float32:
    """Return the discounted sum of rewards to come, Rₜ = Σ_{k ≥ t} γ^{k − t} rₖ.

    Args:
        rewards: float32 [T], the rewards of one whole episode.
        discount: γ in [0, 1].

    Returns:
        float32 [T], summed backwards in float64.

    Raises:
        ValueError: the discount is outside [0, 1].

    Source: section IV, Monte-Carlo policy evaluation (its footnote: no discount, γ = 1).
    """
    if not 0.0 <= discount <= 1.0:
        raise ValueError(f"discount: expected a number in [0, 1], got {discount}")
    returns = np.zeros(len(rewards), np.float64)
    following = 0.0
    for index in range(len(rewards) - 1, -1, -1):
        following = float(rewards[index]) + discount * following
        returns[index] = following
    return returns.astype(np.float32)


def synthetic_action(gripper_poses: Float32, final_pose: Float32, action_limits: Sequence[float]) -> Float32:
    """Return the one action that would lead from each pose to the last, (p_T − pₜ) / limits.

    Args:
        gripper_poses: float32 [T, A], measured before each action; angles unwrapped.
        final_pose: float32 [A], p_T, measured after the last action and before the scripted descent.
        action_limits: A numbers > 0, what an action of 1 commands, in the units of the poses.

    Returns:
        float32 [T, A], in the units of `action`; it may leave [−1, 1], since it spans several steps.

    Raises:
        ValueError: a limit is not greater than 0, or there are more or fewer than A.

    Source: section IV, supervised learning (a = p_T − pₜ).
    Differs: the authors' code sums the commanded actions instead; ours takes measured poses, as the text says.
    """
    limits = np.asarray(action_limits, np.float64)
    if limits.shape != final_pose.shape or not (limits > 0).all():
        raise ValueError(f"action_limits: expected {final_pose.size} numbers greater than 0, got {list(action_limits)}")
    displacement = final_pose.astype(np.float64) - gripper_poses.astype(np.float64)
    return (displacement / limits).astype(np.float32)
