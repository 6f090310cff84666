"""Choosing without a simulator: how well what validation measures on held-back data orders checkpoints by true success.

A measure that orders them well can choose a checkpoint, a setting or an estimator where nobody can try them all.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from graspq.evaluate.statistics import rank_correlation

# Key of a validation, what it is, and whether more of it should be better.
MEASURES = (
    ("roc_auc_last_step", "ROC AUC, last steps", True),
    ("loss_last_step", "cross-entropy, last steps", False),
    ("loss", "held-back loss", False),
    ("opc", "OPC", True),
    ("soft_opc", "SoftOPC", True),
    ("calibration_error", "calibration error", False),
)
FEWEST = 3  # checkpoints, for a correlation to be given


@dataclass(frozen=True)
class ScoredCheckpoint:
    """A checkpoint whose success is known.

    Attributes:
        algo: its estimator.
        validation: what its validation measured, by key; None or missing where it could not.
        rate: its success rate.
    """

    algo: str
    validation: Mapping[str, Any]
    rate: float


@dataclass(frozen=True)
class Choosing:
    """How well a measure orders checkpoints.

    Attributes:
        measure: its key in a validation.
        words: what it is.
        checkpoints: how many have it.
        correlation: Spearman's with success over all of them, 1 where the better by the measure always succeeds more.
        within: the same within one estimator, mean over those with enough checkpoints; None without one.
    """

    measure: str
    words: str
    checkpoints: int
    correlation: float
    within: float | None


def choosing(checkpoints: Sequence[ScoredCheckpoint]) -> list[Choosing]:
    """Return how well each measure orders checkpoints; those of fewer than three, or that never vary, are left out.

    Args:
        checkpoints: scored on the same scenes.
    """
    found = []
    for measure, words, more_is_better in MEASURES:
        known = [one for one in checkpoints if one.validation.get(measure) is not None]
        overall = _correlation(known, measure, more_is_better)
        if overall is not None:
            algos = dict.fromkeys(one.algo for one in known)
            each = (_correlation([one for one in known if one.algo == algo], measure, more_is_better) for algo in algos)
            inner = [value for value in each if value is not None]
            found.append(Choosing(measure, words, len(known), overall, sum(inner) / len(inner) if inner else None))
    return found


def _correlation(checkpoints: Sequence[ScoredCheckpoint], measure: str, more_is_better: bool) -> float | None:
    if len(checkpoints) < FEWEST:
        return None
    sign = 1 if more_is_better else -1
    values = [sign * float(one.validation[measure]) for one in checkpoints]
    return rank_correlation(values, [one.rate for one in checkpoints])
