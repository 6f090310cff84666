"""Intervals for success rates: of one policy, of the difference of two on the same scenes, of a mean over seeds.

Every rate that graspq publishes stands with one of these intervals, 95 % unless it says otherwise.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
import scipy  # its parts are imported when they are first used

CONFIDENCE = 0.95


def wilson_interval(successes: int, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return Wilson's score interval of a success rate.

    (p̂ + z²/2n ± z √(p̂(1-p̂)/n + z²/4n²)) / (1 + z²/n), with p̂ = successes / n and n = trials.

    Args:
        successes: number of successes, 0 .. trials.
        trials: number of episodes, at least 1.
        confidence: coverage, between 0 and 1.

    Returns:
        Lower and upper end, within [0, 1].

    Raises:
        ValueError: `trials` is below 1, or `successes` is not within 0 .. trials.

    Source: Wilson 1927.
    """
    if not 0 <= successes <= trials or trials < 1:
        raise ValueError(f"expected 0 .. trials successes of at least one trial, got {successes} of {trials}")
    z2 = NormalDist().inv_cdf((1 + confidence) / 2) ** 2
    rate = successes / trials
    half = math.sqrt(z2 * (rate * (1 - rate) / trials + z2 / (4 * trials**2)))
    low, high = ((rate + z2 / (2 * trials) + side * half) / (1 + z2 / trials) for side in (-1, 1))
    return 0.0 if successes == 0 else low, 1.0 if successes == trials else high


@dataclass(frozen=True)
class PairedDifference:
    """The difference in success rate of two policies that met the same scenes.

    Attributes:
        difference: rate of the first less rate of the second, in [-1, 1].
        low: lower end of its interval.
        high: upper end of its interval.
        first_only: scenes in which only the first succeeded.
        second_only: scenes in which only the second succeeded.
        scenes: number of scenes.
        p_value: exact McNemar test (two-sided) of equal rates.
    """

    difference: float
    low: float
    high: float
    first_only: int
    second_only: int
    scenes: int
    p_value: float


def paired_difference(
    first: Sequence[bool] | np.ndarray, second: Sequence[bool] | np.ndarray, confidence: float = CONFIDENCE
) -> PairedDifference:
    """Return the difference of two success rates on the same scenes, with an interval.

    Only the scenes in which exactly one policy succeeded tell the two apart (McNemar). With b and c their numbers,
    p₁ = (b+1)/(n+2), p₂ = (c+1)/(n+2): interval p₁ - p₂ ± z √((p₁ + p₂ - (p₁ - p₂)²)/(n+2)), clipped to [-1, 1].

    Args:
        first: success of the first policy in each scene, bool [N].
        second: success of the second policy in the same scenes in the same order, bool [N].
        confidence: coverage, between 0 and 1.

    Raises:
        ValueError: the two differ in length or are empty.

    Source: Bonett & Price 2012 (interval), McNemar 1947 (test).
    """
    one, two = np.asarray(first, dtype=bool), np.asarray(second, dtype=bool)
    if one.shape != two.shape or one.ndim != 1 or one.size == 0:
        raise ValueError(f"expected two equally long lists of successes, got {one.shape} and {two.shape}")
    count = int(one.size)
    b, c = int(np.sum(one & ~two)), int(np.sum(~one & two))
    p1, p2 = (b + 1) / (count + 2), (c + 1) / (count + 2)
    half = NormalDist().inv_cdf(0.5 + confidence / 2) * math.sqrt((p1 + p2 - (p1 - p2) ** 2) / (count + 2))
    p_value = float(scipy.stats.binomtest(b, b + c, 0.5).pvalue) if b + c > 0 else 1.0
    low, high = max(-1.0, p1 - p2 - half), min(1.0, p1 - p2 + half)
    return PairedDifference((b - c) / count, low, high, b, c, count, p_value)


@dataclass(frozen=True)
class MeanOverSeeds:
    """The mean of a number over independent seeds.

    Attributes:
        mean: arithmetic mean.
        low: lower end of Student's interval; None with fewer than two seeds.
        high: upper end; None with fewer than two seeds.
        deviation: sample standard deviation (n - 1); None with fewer than two seeds.
        seeds: number of seeds.
    """

    mean: float
    low: float | None
    high: float | None
    deviation: float | None
    seeds: int


def mean_over_seeds(values: Sequence[float], confidence: float = CONFIDENCE) -> MeanOverSeeds:
    """Return the mean over seeds with Student's interval: m ± t(n-1) s/√n.

    Args:
        values: one number for each seed, such as success rates; at least one.
        confidence: coverage, between 0 and 1.

    Raises:
        ValueError: `values` is empty.
    """
    if len(values) == 0:
        raise ValueError("expected the value of at least one seed")
    mean = float(np.mean(values))
    if len(values) == 1:
        return MeanOverSeeds(mean, None, None, None, 1)
    deviation = float(np.std(values, ddof=1))
    half = float(scipy.stats.t.ppf(0.5 + confidence / 2, len(values) - 1)) * deviation / math.sqrt(len(values))
    return MeanOverSeeds(mean, mean - half, mean + half, deviation, len(values))
