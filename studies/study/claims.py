"""The claims of the paper, one by one, against the scores of studies: each holds, fails, is not decided or not tested.

Each names its test; margins and levels are fixed here, before any score is seen. Source: Quillen et al. 2018.
"""

import itertools
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import scipy

from graspq.common.options import parse_count
from graspq.studies.study.comparisons import Compared, Place, Scored, compare, scored_rows, trainings

Verdict = Literal["holds", "fails", "not decided", "not tested"]
Rows = Mapping[Place, Mapping[str, Scored]]
SEARCH, ACTOR = ("dql", "mc", "corr-mc", "supervised"), ("ddpg", "pcl")
SIX = (*SEARCH, *ACTOR)
SLIGHT = 0.05  # success rates that differ by less are "slightly" different, or "competitive"
DISASTROUS = 0.10
FEWEST_POINTS = 6  # of a sweep, from which on stability can be spoken of


@dataclass(frozen=True)
class Judged:
    """What the scores say of a claim.

    Attributes:
        claim: what the paper says.
        test: what would have to be seen.
        verdict: whether it was.
        seen: the numbers behind the verdict, or what is missing.
    """

    claim: str
    test: str
    verdict: Verdict
    seen: str


def judged(table: Sequence[Mapping[str, Any]]) -> list[Judged]:
    """Return all claims with their verdicts.

    Args:
        table: scores of any number of studies; a row counts by its name, so that `mc` is the `mc` of the recipe and not
            one of its variants.
    """
    rows = scored_rows(table)
    return [*(claim(rows) for claim in CLAIMS), actor_unstable(trainings(table))]


def dql_best_in_low_data(rows: Rows) -> Judged:
    """Judge: DQL performs better in low-data regimes."""
    return _best_of(
        "DQL performs better than the others in low-data regimes",
        "`dql` against each other of the paper's six at 10k, off-policy, on every task that was run; Holm, 5 %",
        _where(rows, ("dql",), size=10_000),
        ("dql",),
    )


def mc_best_at_1m(rows: Rows) -> Judged:
    """Judge: MC and corrected MC are best with much data on the targeted task."""
    return _best_of(
        "MC and Corr-MC are slightly better with much data on the targeted task",
        "`mc` and `corr-mc` each against `dql`, `supervised`, `ddpg` and `pcl` at 1M, targeted; Holm, 5 %",
        _where(rows, ("mc", "corr-mc"), size=1_000_000, task="targeted"),
        ("mc", "corr-mc"),
    )


def bias_of_mc(rows: Rows) -> Judged:
    """Judge: MC is a strong baseline although its target is biased off-policy."""
    return _within(
        "The bias of MC off-policy is not disastrous",
        f"`mc` less the better of `dql` and `corr-mc`: interval above −{DISASTROUS:.2f} everywhere (below: fails)",
        _where(rows, ("mc", "dql", "corr-mc")),
        ("mc",),
        ("dql", "corr-mc"),
        DISASTROUS,
    )


def supervised_competitive(rows: Rows) -> Judged:
    """Judge: supervised learning is among the most successful given enough data."""
    return _within(
        "Supervised learning is competitive",
        f"`supervised` less the best of `dql`, `mc`, `corr-mc`: the whole interval above −{SLIGHT:.2f} everywhere",
        _where(rows, ("supervised", "dql", "mc", "corr-mc")),
        ("supervised",),
        ("dql", "mc", "corr-mc"),
        SLIGHT,
    )


def on_policy_slight(rows: Rows) -> Judged:
    """Judge: on-policy data make a slight difference."""
    claim = "Off- and on-policy differ slightly, for all estimators"
    test = f"each row on-policy less off-policy at the same task, size and scenes: every interval within ±{SLIGHT:.2f}"
    pairs = []
    for place, here in rows.items():
        there = rows.get(Place(place.task, place.size, "off-policy", place.split), {})
        if place.setting == "on-policy":
            pairs += [(here[name], there[name]) for name in SIX if name in here and name in there]
    if not pairs:
        return Judged(claim, test, "not tested", "no row was scored both ways")
    found = compare([pair for pair in pairs if _same_scenes(*pair)])
    inside = all(one.difference.low > -SLIGHT and one.difference.high < SLIGHT for one in found)
    outside = any(one.difference.low > SLIGHT or one.difference.high < -SLIGHT for one in found)
    return Judged(claim, test, "holds" if inside else "fails" if outside else "not decided", _list(found))


def actor_worse(rows: Rows) -> Judged:
    """Judge: methods with an actor network are worse than those that search."""
    claim = "Methods with an actor network are worse than those with stochastic search"
    test = (
        "`ddpg` and `pcl` each against `dql`, `mc`, `corr-mc`, `supervised`; Holm, 5 %: all worse (any better: fails)"
    )
    found = []
    for here in _where(rows, ("ddpg",)).values():
        pairs = itertools.product(_named(here, ACTOR), _named(here, SEARCH))
        found += compare([pair for pair in pairs if _same_scenes(*pair)])
    if not found:
        return Judged(claim, test, "not tested", "no row with an actor stands beside one that searches")
    verdict: Verdict = "not decided"
    if any(one.better for one in found):
        verdict = "fails"
    elif all(one.worse for one in found):
        verdict = "holds"
    return Judged(claim, test, verdict, _list([one for one in found if not one.worse] or found))


def actor_unstable(found: Mapping[Place, Mapping[str, Sequence[tuple[str, float]]]]) -> Judged:
    """Judge: methods with an actor network are unstable over hyperparameters."""
    claim = "Methods with an actor network are unstable over hyperparameters and seeds"
    test = (
        f"at least {FEWEST_POINTS} trainings of `ddpg` and of a row that searches, over settings and seeds: shortfalls "
        "(best rate less each) are larger with the actor, Mann-Whitney, one-sided, 5 %"
    )
    for place, here in found.items():
        swept = {
            algo: [rate for _, rate in some]
            for algo, some in here.items()
            if len({name for name, _ in some}) > 1 and len(some) >= FEWEST_POINTS
        }
        actor, search = (
            [max(rates) - rate for algo, rates in swept.items() if algo in group for rate in rates]
            for group in (ACTOR[:1], SEARCH)
        )
        if actor and search:
            p = float(scipy.stats.mannwhitneyu(actor, search, alternative="greater").pvalue)
            lower = float(scipy.stats.mannwhitneyu(actor, search, alternative="less").pvalue)
            seen = (
                f"{place}: median shortfall {statistics.median(actor):.3f} of {len(actor)} with the actor, "
                f"{statistics.median(search):.3f} of {len(search)} that search; p {p:.3f}"
            )
            return Judged(claim, test, "holds" if p < 0.05 else "fails" if lower < 0.05 else "not decided", seen)
    return Judged(claim, test, "not tested", "no study here varies the settings of both")


def ninety_percent(rows: Rows) -> Judged:
    """Judge: unseen objects are grasped with 90 % success."""
    claim = "Previously unseen objects are grasped with an average success rate of 90 %"
    test = (
        "regular task, test split, the best row of the six: interval of its mean, new seeds, scenes and objects: ≥ 0.90"
    )
    best: tuple[Place, Scored] | None = None
    for place, here in _where(rows, (), task="regular").items():
        for one in _named(here, SIX) if place.split.startswith("test") else []:
            if best is None or one.mean.value > best[1].mean.value:
                best = place, one
    if best is None:
        return Judged(claim, test, "not tested", "no score on the test split")
    place, row = best
    verdict: Verdict = "holds" if row.mean.low >= 0.9 else "fails" if row.mean.high < 0.9 else "not decided"
    return Judged(claim, test, verdict, f"{row.name} ({place}): {_interval(row)}, {len(row.rows)} seeds")


CLAIMS: tuple[Callable[[Rows], Judged], ...] = (
    dql_best_in_low_data,
    mc_best_at_1m,
    bias_of_mc,
    on_policy_slight,
    actor_worse,
    supervised_competitive,
    ninety_percent,
)


def _where(rows: Rows, needed: Sequence[str], *, size: int | None = None, task: str | None = None) -> Rows:
    """Return the off-policy places with these rows, of a size and task where they are given."""
    return {
        place: here
        for place, here in rows.items()
        if place.setting == "off-policy"
        and all(name in here for name in needed)
        and size in (None, parse_count(place.size))
        and task in (None, place.task)
    }


def _named(here: Mapping[str, Scored], names: Sequence[str]) -> list[Scored]:
    return [here[name] for name in names if name in here]


def _same_scenes(first: Scored, second: Scored) -> bool:
    return bool(first.success.shape[1] == second.success.shape[1])


def _best_of(claim: str, test: str, rows: Rows, winners: Sequence[str]) -> Judged:
    found: list[Compared] = []
    for here in rows.values():
        rivals = _named(here, [name for name in SIX if name not in winners])
        pairs = itertools.product(_named(here, winners), rivals)
        found += compare([pair for pair in pairs if _same_scenes(*pair)])
    if not found:
        return Judged(claim, test, "not tested", f"{' and '.join(winners)} were not scored there beside others")
    verdict: Verdict = "not decided"
    if any(one.worse for one in found):
        verdict = "fails"
    elif all(one.better for one in found):
        verdict = "holds"
    return Judged(claim, test, verdict, _list([one for one in found if not one.better] or found))


def _within(
    claim: str, test: str, rows: Rows, candidates: Sequence[str], rivals: Sequence[str], margin: float
) -> Judged:
    found = []
    for here in rows.values():
        best = max(_named(here, rivals), key=lambda one: one.mean.value)
        found += compare([(one, best) for one in _named(here, candidates) if _same_scenes(one, best)])
    if not found:
        return Judged(claim, test, "not tested", f"not all of {', '.join((*candidates, *rivals))} were scored together")
    inside = all(one.difference.low > -margin for one in found)
    outside = any(one.difference.high < -margin for one in found)
    return Judged(claim, test, "holds" if inside else "fails" if outside else "not decided", _list(found))


def _interval(row: Scored) -> str:
    return f"{row.mean.value:.3f} ({row.mean.low:.3f} to {row.mean.high:.3f})"


def _list(found: Sequence[Compared]) -> str:
    return "; ".join(map(str, found))
