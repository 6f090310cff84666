"""`supervised`: the outcome of the episode, regressed on the motion that would have led from a pose to the last one.

What a policy needs besides the network, where that motion may lie at each step, is measured in the training data.
Dimensions: B batch, T steps, A action.

Differs:
1. A motion spans several steps; the paper does not say how it becomes one. Here the policy searches whole motions, as
   the network was trained on, and takes the first step of the best one. The released code searches single steps, which
   are not what its network learned from at any but the last step.
2. p_T - p_t is of measured poses, as the text has it; the released code adds up the commanded actions.
3. The search starts from mean and deviation of the motions at that step in the data, and stays in their range, not from
   (0, 0, -1, 0) as for single steps.
4. The range is cut to end poses inside the workspace by the gripper's pose, which the simulator or robot tells the
   policy. It is no part of the state, and no network sees it.
5. At steps that are rare in the data the range is as narrow as those few motions, and at a step that no training
   episode reached it is that of the last step that one did.
"""

import torch
from torch import Tensor

from graspq.datasets.pool import ShardPool
from graspq.train.batch import Batch
from graspq.train.selection import SearchSpace

PREFIX = "synthetic_"


def synthetic_action(batch: Batch) -> Tensor:
    """Return final pose minus current pose in units of the action limits; float32 [B, T, A].

    Source: Quillen et al. 2018, section "Learning to Grasp with Supervised Learning".
    Differs: see the list of the module.
    """
    return batch.synthetic_action


def measured_motions(pool: ShardPool) -> dict[str, Tensor]:
    """Return mean, standard deviation (n), least and greatest synthetic action of each step in the data.

    Returns:
        `synthetic_mean`, `synthetic_deviation`, `synthetic_low` and `synthetic_high`, float32 [T, A].
    """
    rows = [pool.read_columns(ref, ("step", "synthetic_action")) for ref in pool.blocks]
    steps = torch.cat([torch.from_numpy(columns["step"].astype("int64")) for columns in rows])
    motions = torch.cat([torch.from_numpy(columns["synthetic_action"].astype("float64")) for columns in rows])
    measured: list[list[Tensor]] = []
    for step in range(pool.max_steps):
        here = motions[steps == step]
        moments = [here.mean(0), here.std(0, correction=0), here.amin(0), here.amax(0)] if len(here) else measured[-1]
        measured.append(moments)
    return {
        PREFIX + name: torch.stack(values).float()
        for name, values in zip(SearchSpace._fields, zip(*measured, strict=True), strict=True)
    }


def motions_at(extra: dict[str, Tensor], step: Tensor) -> SearchSpace:
    """Return where the search for a motion starts and may go, [B, A], at steps int64 [B]; later ones count as T - 1.

    Args:
        extra: what `measured_motions` returned.
        step: number of actions taken so far.
    """
    tables = [extra[PREFIX + name] for name in SearchSpace._fields]
    return SearchSpace(*(table[step.clamp(0, len(table) - 1)] for table in tables))


def cut_to(space: SearchSpace, low: Tensor, high: Tensor) -> SearchSpace:
    """Return the space less what is out of reach; where nothing of it is within reach, the nearest that is.

    Args:
        space: see `motions_at`.
        low: least motion that is possible, float [B, A].
        high: greatest, at least `low`.
    """

    def reachable(bound: Tensor) -> Tensor:
        return torch.minimum(torch.maximum(bound, low.to(bound)), high.to(bound))

    return space._replace(low=reachable(space.low), high=reachable(space.high))
