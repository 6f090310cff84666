"""How good a Q-function is on grasps it was not trained on: loss, calibration and ROC AUC.

Calibration and AUC look at last steps alone: there Q(s, a) is the chance of success for every estimator, whatever its
target is before. OPC and SoftOPC look at all steps. Dimension key: n steps.
"""

import dataclasses
from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from graspq.train.batch import Batch
from graspq.train.estimator import Estimator, S
from graspq.train.state import Networks

Floats = npt.NDArray[np.floating[Any]]
BINS = 10
SURE = 1e-6


@dataclasses.dataclass(frozen=True)
class Validation:
    """Measures on held-back transitions.

    Attributes:
        transitions: how many were looked at.
        last_steps: how many of them were the last of their episode.
        loss: mean loss against the estimator's own target; compares runs of one estimator and one loss.
        loss_last_step: mean cross-entropy between Q and the reward at last steps, nats; compares all runs.
        roc_auc_last_step: chance that a success has a higher Q than a failure, at last steps; None without both.
        opc: how well Q tells the steps of successes from all, see `opc`; None without a success or a Q.
        soft_opc: the same without a threshold, see `soft_opc`.
        calibration_error: mean distance of Q and the rate of success over bins of Q, weighted by their counts.
        calibration: 10 equal bins of Q in [0, 1]: `low, high, count, mean_q, success_rate` (None where empty).
    """

    transitions: int
    last_steps: int
    loss: float
    loss_last_step: float | None
    roc_auc_last_step: float | None
    opc: float | None
    soft_opc: float | None
    calibration_error: float | None
    calibration: list[dict[str, float | int | None]]

    def to_json(self) -> dict[str, Any]:
        """Return the measures as plain JSON values."""
        return dataclasses.asdict(self)


@torch.no_grad()
def validate(
    batches: Iterable[Batch],
    estimator: Estimator[S],
    networks: Networks,
    settings: S,
    random: torch.Generator,
    progress: float,
) -> Validation | None:
    """Judge networks on batches, in evaluation mode; None where there are none.

    Args:
        batches: held back from training.
        estimator: whose target they have.
        networks: to be judged.
        settings: of the estimator.
        random: random numbers of the targets.
        progress: part of the training that is done, in [0, 1].
    """
    for network in networks.online.values():
        network.eval()
    total, count, last_steps = 0.0, 0, 0
    scores, rewards, succeeded, is_last = [], [], [], []
    for batch in batches:
        size = int(batch.real_steps)
        total += float(estimator.objective(estimator, batch, networks, settings, random, progress)) * size
        count += size
        last = batch.real(batch.terminal)
        last_steps += int(last.sum())
        if "q" in estimator.parts:
            with networks.autocast():
                q_of = networks.q.at(batch.real(batch.image), batch.real(batch.step))
                score = q_of(batch.real(estimator.regressed_action(batch)).unsqueeze(1)).squeeze(1)
            scores.append(score.float().cpu().numpy())
            rewards.append(batch.real(batch.reward).cpu().numpy())
            # Rewards are 0 but for a success at the end: the return says whether the episode ends in one.
            succeeded.append((batch.real(batch.mc_return) > 0).cpu().numpy())
            is_last.append(last.cpu().numpy())
    if count == 0:
        return None
    # Where training diverged Q may be no number; the loss says so, and the loop stops.
    every_q = np.nan_to_num(np.concatenate(scores).astype(np.float64)) if scores else np.zeros(0)
    success, at_end = (np.concatenate(some) if some else np.zeros(0, dtype=np.bool_) for some in (succeeded, is_last))
    q, reward = every_q[at_end], (np.concatenate(rewards) if rewards else np.zeros(0, dtype=np.float32))[at_end]
    rows, error = calibration(q, reward)
    return Validation(
        transitions=count,
        last_steps=last_steps,
        loss=total / count,
        loss_last_step=_cross_entropy(q, reward),
        roc_auc_last_step=roc_auc(q, reward > 0.5),
        opc=opc(every_q, success),
        soft_opc=soft_opc(every_q, success),
        calibration_error=error,
        calibration=rows,
    )


def roc_auc(score: Floats, positive: npt.NDArray[np.bool_]) -> float | None:
    """Return the area under the ROC curve: the chance that a positive scores higher than a negative, ties counting ½.

        AUC = (Σ ranks of the positives - p (p + 1) / 2) / (p n)

    Args:
        score: float [n].
        positive: bool [n].

    Returns:
        A number in [0, 1], or None without both a positive and a negative.
    """
    positives, negatives = int(positive.sum()), int((~positive).sum())
    if positives == 0 or negatives == 0:
        return None
    _, place, counts = np.unique(score, return_inverse=True, return_counts=True)
    last_rank = np.cumsum(counts)
    rank = (last_rank - (counts - 1) / 2)[place]
    return float((rank[positive].sum() - positives * (positives + 1) / 2) / (positives * negatives))


def opc(q: Floats, success: npt.NDArray[np.bool_]) -> float | None:
    """Return OPC, how well a threshold on Q tells steps from which a success can follow from those where it cannot.

    Every step of a success is known to be one from which success can follow (positive); of all others nothing is known
    (unlabelled). With 𝟙 an indicator, the best b, and p = 1 for the unknown share of positive steps, as they simplify,

        OPC = max_b (p E[𝟙(Q > b) | success] - E[𝟙(Q > b)]).

    Args:
        q: Q(s, a) of logged steps, float [n].
        success: whether the step's episode ended in success, bool [n].

    Returns:
        A number in [0, 1), higher is better; None without a success.

    Source: Irpan et al. 2019, "Off-policy evaluation via off-policy classification", section 4.
    """
    if not success.any():
        return None
    _, place = np.unique(q, return_inverse=True)
    of_all, of_successes = (np.bincount(some, minlength=place.max() + 1) for some in (place, place[success]))
    # The part that lies above each value of Q; b = -∞ would give 0, as the highest does.
    above_all, above_successes = (1 - np.cumsum(some) / some.sum() for some in (of_all, of_successes))
    return float(np.max(above_successes - above_all))


def soft_opc(q: Floats, success: npt.NDArray[np.bool_]) -> float | None:
    """Return SoftOPC, OPC with Q itself in place of its indicator: p E[Q | success] - E[Q], p = 1; see `opc`.

    Args:
        q: Q(s, a) of logged steps, float [n].
        success: whether the step's episode ended in success, bool [n].

    Returns:
        A number, higher is better; None without a success. It grows with the scale of Q.

    Source: Irpan et al. 2019, section 4.
    """
    return float(q[success].mean() - q.mean()) if success.any() else None


def calibration(q: Floats, outcome: Floats) -> tuple[list[dict[str, float | int | None]], float | None]:
    """Return the table of 10 equal bins of Q, and the expected calibration error.

        ECE = Σ_b n_b / n |mean Q in b - rate of success in b|

    Args:
        q: float [n]; values outside [0, 1] count as 0 or 1.
        outcome: float [n], 0 or 1.

    Returns:
        The rows, see `Validation.calibration`, and the error; None for n = 0.
    """
    q = np.clip(q, 0, 1)
    bins = np.minimum((q * BINS).astype(np.int64), BINS - 1)
    rows: list[dict[str, float | int | None]] = []
    error = 0.0
    for index in range(BINS):
        inside = bins == index
        count = int(inside.sum())
        mean_q = float(q[inside].mean()) if count else None
        rate = float(outcome[inside].mean()) if count else None
        if mean_q is not None and rate is not None:
            error += count / len(q) * abs(mean_q - rate)
        bounds = {"low": index / BINS, "high": (index + 1) / BINS}
        rows.append({**bounds, "count": count, "mean_q": mean_q, "success_rate": rate})
    return rows, error if len(q) else None


def _cross_entropy(q: Floats, outcome: Floats) -> float | None:
    if len(q) == 0:
        return None
    q = np.clip(q, SURE, 1 - SURE)
    return float(-np.mean(outcome * np.log(q) + (1 - outcome) * np.log(1 - q)))
