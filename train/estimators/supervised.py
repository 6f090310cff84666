"""`supervised`: the outcome of the episode, regressed on the motion that would have led from a pose to the last one.

Where that motion may lie at each step, which a policy needs besides the network, is measured in the training data.
Dimensions: B batch, T steps, A action.
"""

import dataclasses
from collections.abc import Mapping

import torch
from torch import Tensor

from graspq.common.options import setting
from graspq.datasets.pool import ShardPool
from graspq.train.acting import Acting, ObservedState, StochasticSearch
from graspq.train.batch import Batch
from graspq.train.estimator import Estimator, RegressionSettings, TargetValue
from graspq.train.estimators import mc
from graspq.train.search_settings import CemSettings, StepMode
from graspq.train.selection import SearchSpace

PREFIX, USE_POSE = "synthetic_", "use_pose"


@dataclasses.dataclass(frozen=True)
class SupervisedSettings(RegressionSettings):
    """Options of `supervised`; its target is that of `mc`, the return, which without discount is the outcome."""

    use_pose: bool = setting(
        False, help="Let the policy know the gripper's pose, and search motions that end inside the workspace alone."
    )

    def chosen_discount(self, stored: float) -> float:
        """Return 1: the outcome has no discount."""
        return 1.0


def synthetic_action(batch: Batch) -> Tensor:
    """Return final pose minus current pose in units of the action limits; float32 [B, T, A].

    Source: Quillen et al. 2018, section "Learning to Grasp with Supervised Learning".
    Differs: 1. Of measured poses, as the text has it; the released code adds up the commanded actions.
    """
    return batch.synthetic_action


def measured_motions(pool: ShardPool, settings: SupervisedSettings) -> dict[str, Tensor]:
    """Return mean, standard deviation (n), least and greatest synthetic action of each step in the data; `use_pose`.

    A step that no training episode reached has those of the last step that one did.

    Returns:
        `synthetic_mean`, `synthetic_deviation`, `synthetic_low` and `synthetic_high`, float32 [T, A]; `use_pose`, bool.
    """
    rows = [pool.read_columns(ref, ("step", "synthetic_action")) for ref in pool.blocks]
    steps = torch.cat([torch.from_numpy(columns["step"].astype("int64")) for columns in rows])
    motions = torch.cat([torch.from_numpy(columns["synthetic_action"].astype("float64")) for columns in rows])
    measured: list[list[Tensor]] = []
    for step in range(pool.max_steps):
        here = motions[steps == step]
        moments = [here.mean(0), here.std(0, correction=0), here.amin(0), here.amax(0)] if len(here) else measured[-1]
        measured.append(moments)
    tables = {
        PREFIX + name: torch.stack(values).float()
        for name, values in zip(SearchSpace._fields, zip(*measured, strict=True), strict=True)
    }
    return tables | {USE_POSE: torch.tensor(settings.use_pose)}


def motions_at(kept: Mapping[str, Tensor], step: Tensor) -> SearchSpace:
    """Return where the search for a motion starts and may go, [B, A], at steps int64 [B]; later ones count as T - 1.

    Args:
        kept: what `measured_motions` returned.
        step: number of actions taken so far.
    """
    tables = [kept[PREFIX + name] for name in SearchSpace._fields]
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


def one_step_of(displacement: Tensor, mode: StepMode) -> Tensor:
    """Return the first step of a displacement that may need several, as an action.

        scale:  a = d / max(1, maxᵢ |dᵢ|)     a straight line, all parts arrive together
        clip:   aᵢ = clip(dᵢ, -1, 1)          each part as fast as it may

    Args:
        displacement: d, float [B, A] in units of the action limits.
        mode: see above.

    Returns:
        float [B, A] in [-1, 1].
    """
    if mode == "clip":
        return displacement.clamp(-1, 1)
    return displacement / displacement.abs().amax(-1, keepdim=True).clamp(min=1)


class SearchOfMotions(StochasticSearch):
    """The cross-entropy method over whole motions to the last pose, as the network learned them; one step is taken.

    Differs: 2. The released code searches single steps, which are not what its network learned from at any but the last
    step. 3. The search starts from the motions of that step in the data and stays in their range; with `--use-pose` it
    is cut to end poses inside the workspace. No network sees the pose.
    """

    def space(self, acting: Acting, state: ObservedState, near: Tensor) -> SearchSpace:
        """Return the motions of the data at this step; with `use_pose` those that end inside the workspace."""
        space = SearchSpace(*(bound.to(near) for bound in motions_at(acting.kept, state.step)))
        if state.pose is None or acting.pose_bounds is None or not bool(acting.kept[USE_POSE]):
            return space
        low, high = acting.pose_bounds
        limits = torch.tensor(acting.action.limits, device=near.device)
        return cut_to(space, (low - state.pose) / limits, (high - state.pose) / limits)

    def executed(self, found: Tensor, cem: CemSettings) -> Tensor:
        """Return the first step of a motion."""
        return one_step_of(found, cem.synthetic_step)


row = Estimator(
    summary="The outcome of the episode, as if one motion had led from the current pose to the last one",
    settings=SupervisedSettings,
    target_value=TargetValue("episode value, on synthetic actions", mc.target),
    action_selection=SearchOfMotions(),
    paper=SupervisedSettings(loss="huber"),
    regressed_action=synthetic_action,
    kept=measured_motions,
)
