"""Statistics of success rates: one policy, two on the same scenes, several training runs of a row, many comparisons.

Every rate that graspq publishes stands with one of these intervals, 95 % unless it says otherwise. Dimension key:
S runs (training seeds) of a row, N scenes that all of them met, O objects, R draws. docs/statistics.md says why these.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
import numpy.typing as npt
import scipy  # its parts are imported when they are first used

Floats = npt.NDArray[np.float64]
Outcomes = npt.NDArray[np.bool_] | Floats
DRAWS = 2000
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
class Interval:
    """A number with its interval.

    Attributes:
        value: the estimate.
        low: lower end.
        high: upper end.
    """

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class SeveralRuns(Interval):
    """A rate, or a difference of two, over several training runs that met the same scenes.

    Attributes:
        error: its standard error.
        freedom: degrees of freedom of Student's distribution.
        scenes: number of scenes.
    """

    error: float
    freedom: float
    scenes: int

    @property
    def p_value(self) -> float:
        """Return the two-sided p-value of the hypothesis that the number is 0."""
        return 2 * float(scipy.stats.t.sf(abs(self.value) / self.error, self.freedom))


def mean_success(success: Outcomes, counts: Floats | None = None, confidence: float = CONFIDENCE) -> SeveralRuns:
    """Return the mean success rate of a row's runs: what new runs would reach in new scenes with new objects.

    Runs and scenes are crossed, each adds an effect of its own: y_is = μ + run_i + scene_s + ε_is. So

        Var ȳ = max(0, s²(ȳ_i.) / S - σ̂² / (S N)) + s²(ȳ_.s) / N + object_variance,

    with s² the sample variance (of the runs' means, of the scenes' means) and σ̂² = Σ (y_is - ȳ_i. - ȳ_.s + ȳ)² /
    ((S - 1) (N - 1)); σ̂² is taken away once since both variances hold it. The interval is ȳ ± t(ν) √Var, clipped to
    [0, 1], with ν = Var² / (Σ part² / its freedom) (Welch & Satterthwaite), the parts being s²(ȳ_i.) / S with S - 1 and
    s²(ȳ_.s) / N with N - 1, and ν no less than the least of these. Where nothing varies it is Wilson's of one run.

    Args:
        success: outcome of each run in each scene, bool [S, N]. One run has no variance between runs: then the interval
            speaks of this run alone.
        counts: objects in the scenes, see `object_counts`; None for an interval that speaks of these objects alone.
        confidence: coverage, between 0 and 1.

    Raises:
        ValueError: there are fewer than two scenes.

    Source: Searle, Casella & McCulloch 1992, chapter 4 (two-way crossed, one observation a cell); Satterthwaite 1946.
    """
    runs = _runs(success)
    alone = wilson_interval(int(runs[0].sum()), runs.shape[1], confidence)
    return _estimate([runs], runs.mean(0), counts, confidence, alone, 0.0)


def success_difference(
    first: Outcomes, second: Outcomes, counts: Floats | None = None, confidence: float = CONFIDENCE
) -> SeveralRuns:
    """Return the difference of two rows' mean success rates on the same scenes: first less second.

    Runs of the two rows are independent, scenes are shared: with d_s = ȳ1_.s - ȳ2_.s

        Var d̄ = Σ_rows max(0, s²(ȳ_i.) / S - σ̂² / (S N)) + s²(d_s) / N + object_variance(d),

    and all else as in `mean_success`; clipped to [-1, 1]. A row of one run has no variance between runs: the answer
    then speaks of that run alone. Where nothing varies the interval is that of `paired_difference`.

    Args:
        first: outcomes of the first row, bool [S1, N].
        second: of the second in the same scenes in the same order, bool [S2, N].
        counts: objects in the scenes, see `object_counts`; None for an answer that speaks of these objects alone.
        confidence: coverage, between 0 and 1.

    Raises:
        ValueError: the two differ in their number of scenes, or there are fewer than two.
    """
    one, two = _runs(first), _runs(second)
    if one.shape[1] != two.shape[1]:
        raise ValueError(f"expected outcomes in the same scenes, got {one.shape[1]} and {two.shape[1]} of them")
    alone = paired_difference(one[0], two[0], confidence)
    score = one.mean(0) - two.mean(0)
    return _estimate([one, two], score, counts, confidence, (alone.low, alone.high), -1.0)


def _runs(success: Outcomes) -> Floats:
    runs = np.asarray(success, dtype=np.float64)
    if runs.ndim != 2 or runs.shape[0] < 1 or runs.shape[1] < 2:
        raise ValueError(f"expected the outcomes of runs in at least two scenes, [S, N], got {runs.shape}")
    return runs


def _estimate(
    rows: Sequence[Floats],
    score: Floats,
    counts: Floats | None,
    confidence: float,
    alone: tuple[float, float],
    least: float,
) -> SeveralRuns:
    """Return the mean of `score` over scenes; `alone` is the interval of single runs, `least` the least possible."""
    scenes, value = len(score), float(score.mean())
    parts = [(float(score.var(ddof=1)) / scenes, scenes - 1)]
    variance = parts[0][0]
    for runs in rows:
        if len(runs) > 1:
            between = float(runs.mean(1).var(ddof=1)) / len(runs)
            rest = runs - runs.mean(1, keepdims=True) - runs.mean(0) + runs.mean()
            residual = float((rest**2).sum()) / ((len(runs) - 1) * (scenes - 1))
            parts.append((between, len(runs) - 1))
            variance += max(0.0, between - residual / (len(runs) * scenes))
    variance += object_variance(score, counts) if counts is not None else 0.0
    if variance < 1e-15:
        low, high = alone
        error = (high - low) / (2 * NormalDist().inv_cdf(0.5 + confidence / 2))
        return SeveralRuns(value, low, high, error, scenes - 1.0, scenes)
    error = math.sqrt(variance)
    # The parts hold what was taken away from the variance: where little is left, the formula falls below all of theirs.
    freedom = max(
        variance**2 / sum(part**2 / degrees for part, degrees in parts), min(float(degrees) for _, degrees in parts)
    )
    half = float(scipy.stats.t.ppf(0.5 + confidence / 2, freedom)) * error
    return SeveralRuns(value, max(least, value - half), min(1.0, value + half), error, freedom, scenes)


def object_counts(object_ids: Sequence[Sequence[str]]) -> Floats:
    """Return how often each object lies in each scene, [N, O]; objects are in the order of their ids."""
    places = {name: place for place, name in enumerate(sorted({name for ids in object_ids for name in ids}))}
    counts = np.zeros((len(object_ids), len(places)))
    for scene, ids in enumerate(object_ids):
        for name in ids:
            counts[scene, places[name]] += 1
    return counts


def object_variance(score: Floats, counts: Floats) -> float:
    """Return the variance that a mean over scenes has because the split might have held other objects.

    A scene holds several objects, so that objects cannot be resampled as scenes can. Each object o adds an effect of
    its own: y_s = μ + Σ_o K_so a_o + ε_s, with Var a_o = σ². Then two scenes covary by σ² k_st, where k_st = Σ_o K_so
    K_to counts the objects that they share, and σ² is the slope of products on k over all pairs s ≠ t:

        σ̂² = max(0, Σ (k_st - k̄) e_s e_t / Σ (k_st - k̄)²), e_s = y_s - ȳ;   variance of ȳ = σ̂² Σ_o (Σ_s K_so / N)².

    Args:
        score: of each scene, a rate or a difference of two, [N].
        counts: K, see `object_counts`, [N, O].

    Returns:
        The variance; 0 where all pairs of scenes share equally many objects, since then nothing can be said.

    Source: the regression of products of residuals on shared groups (Haseman & Elston 1972, there for relatives).
    """
    e, pairs = score - score.mean(), len(score) * (len(score) - 1)
    # Sums over all pairs s ≠ t without forming them: the sum over all s, t less that over s = t.
    own = (counts**2).sum(1)
    shared = float((counts.sum(0) ** 2).sum() - own.sum())
    shared_squared = float(((counts.T @ counts) ** 2).sum() - (own**2).sum())
    products = -float((e**2).sum())
    both = float(((counts.T @ e) ** 2).sum() - (own * e**2).sum())
    spread = shared_squared - shared**2 / pairs
    if spread <= 1e-9 * pairs:
        return 0.0
    return max(0.0, (both - shared * products / pairs) / spread) * float((counts.mean(0) ** 2).sum())


def crossed_draws(rows: Sequence[Outcomes], draws: int, rng: np.random.Generator) -> list[Floats]:
    """Resample runs and scenes; return the success rates of the drawn runs in the drawn scenes, a [R, S] for each row.

    In every draw each row's S runs and the N scenes are drawn with replacement, independently: the scenes once for all
    rows, since all met them, the runs for each row. Resampling single episodes instead would take S x N dependent
    outcomes for independent ones.

    Args:
        rows: outcomes of each row's runs in the same scenes, each bool [S, N].
        draws: number of draws R.
        rng: the draws.

    Source: Owen 2007 ("pigeonhole bootstrap" of crossed factors).
    """
    scenes = rows[0].shape[1]
    weights = rng.multinomial(scenes, np.full(scenes, 1 / scenes), draws) / scenes
    rates = [weights @ np.asarray(runs, dtype=np.float64).T for runs in rows]
    return [np.take_along_axis(rate, rng.integers(rate.shape[1], size=rate.shape), 1) for rate in rates]


def bootstrap_interval(
    strata: Sequence[Outcomes], rng: np.random.Generator, draws: int = DRAWS, confidence: float = CONFIDENCE
) -> Interval:
    """Return the mean over strata of the mean success rate, with its stratified bootstrap percentile interval.

    Args:
        strata: outcomes of a row in each stratum (a task, say), each bool [S, N]; each is drawn by itself.
        rng: the draws.
        draws: number of draws.
        confidence: coverage, between 0 and 1.

    Source: Agarwal et al. 2021 (rliable). Differs: 1. scenes are resampled too, see `crossed_draws`.
    """
    drawn = np.mean([crossed_draws([runs], draws, rng)[0].mean(1) for runs in strata], axis=0)
    return Interval(float(np.mean([np.mean(runs) for runs in strata])), *_percentiles(drawn, confidence))


def probability_of_improvement(
    first: Outcomes, second: Outcomes, rng: np.random.Generator, draws: int = DRAWS, confidence: float = CONFIDENCE
) -> Interval:
    """Return how likely a run of the first row is to have a higher success rate than one of the second.

        P = Σ_i Σ_j ([p_i > q_j] + ½ [p_i = q_j]) / (S1 S2), with p_i, q_j the rates of single runs

    Args:
        first: outcomes of the first row, bool [S1, N].
        second: of the second in the same scenes, bool [S2, N].
        rng: draws of the percentile interval, see `crossed_draws`.
        draws: number of draws.
        confidence: coverage, between 0 and 1.

    Source: Agarwal et al. 2021 (rliable), section 4.3.
    """
    drawn = _improvement(*crossed_draws([first, second], draws, rng))
    value = _improvement(np.mean(first, 1)[None], np.mean(second, 1)[None])
    return Interval(float(value[0]), *_percentiles(drawn, confidence))


def _improvement(first: Floats, second: Floats) -> Floats:
    # Rates of equal counts may differ in the last bit, where scenes were weighted.
    differences = np.round(first[:, :, None] - second[:, None, :], 12)
    better: Floats = ((np.sign(differences) + 1) / 2).mean((1, 2))
    return better


@dataclass(frozen=True)
class Profile:
    """The share of a row's runs that are better than each threshold.

    Attributes:
        thresholds: success rates τ, [K].
        share: F(τ), [K].
        low: lower end of its interval at each τ, [K].
        high: upper end, [K].
    """

    thresholds: Floats
    share: Floats
    low: Floats
    high: Floats


def performance_profile(
    success: Outcomes,
    thresholds: Floats,
    rng: np.random.Generator,
    draws: int = DRAWS,
    confidence: float = CONFIDENCE,
) -> Profile:
    """Return a row's performance profile: F(τ) = Σ_i [p_i > τ] / S, with p_i the success rates of its runs.

    Args:
        success: outcomes of its runs, bool [S, N].
        thresholds: τ, float [K].
        rng: draws of the pointwise percentile intervals, see `crossed_draws`.
        draws: number of draws.
        confidence: coverage, between 0 and 1.

    Source: Agarwal et al. 2021 (rliable), section 4.2 (run-score distributions).
    """
    rates = np.mean(success, 1)
    drawn = (crossed_draws([success], draws, rng)[0][:, :, None] > thresholds + 1e-12).mean(1)
    low, high = np.quantile(drawn, [(1 - confidence) / 2, (1 + confidence) / 2], axis=0)
    return Profile(thresholds, (rates[:, None] > thresholds + 1e-12).mean(0), low, high)


def _percentiles(drawn: Floats, confidence: float) -> tuple[float, float]:
    low, high = np.quantile(drawn, [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(low), float(high)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values adjusted for being many, in their order: at most as many false alarms as one test has.

    The j-th smallest of m becomes max over i <= j of (m - i + 1) p_(i), at most 1.

    Source: Holm 1979.
    """
    adjusted, greatest = [1.0] * len(p_values), 0.0
    for rank, place in enumerate(np.argsort(np.asarray(p_values, dtype=np.float64), kind="stable")):
        greatest = max(greatest, (len(p_values) - rank) * p_values[place])
        adjusted[place] = min(1.0, greatest)
    return adjusted


def rank_correlation(first: Sequence[float], second: Sequence[float]) -> float | None:
    """Return Spearman's rank correlation: Pearson's of the ranks, ties having their mean rank.

    Args:
        first: numbers, [n].
        second: as many.

    Returns:
        A number in [-1, 1]; None where one of the two never varies.

    Source: Spearman 1904.
    """
    ranks = [_ranks(np.asarray(values, dtype=np.float64)) for values in (first, second)]
    if len(first) != len(second) or any(np.ptp(rank) == 0 for rank in ranks if len(rank)) or len(first) < 2:
        return None
    return float(np.corrcoef(ranks[0], ranks[1])[0, 1])


def _ranks(values: Floats) -> Floats:
    _, place, counts = np.unique(values, return_inverse=True, return_counts=True)
    ranks: Floats = (np.cumsum(counts) - (counts - 1) / 2)[place]
    return ranks
