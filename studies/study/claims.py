"""The claims of the paper, one by one, against the scores of studies: each holds, fails, is not decided or not tested.

Each names its test; margins and levels are fixed here. They were written before version 2's `test` objects were opened,
and made stricter when one of five seeds of the study at 10k and four trainings of the second were known: all rows that
a claim speaks of must be there, and intervals are widened where one of many decides. Source: Quillen et al. 2018.
"""

import itertools
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import scipy

from graspq.common.options import parse_count
from graspq.studies.study.comparisons import (
    Compared,
    Place,
    Scored,
    asked_rows,
    compare,
    trainings,
    widened_confidence,
)

Verdict = Literal["holds", "fails", "not decided", "not tested"]
Rows = Mapping[Place, Mapping[str, Scored]]
SEARCH, ACTOR = ("dql", "mc", "corr-mc", "supervised"), ("ddpg", "pcl")
SIX = (*SEARCH, *ACTOR)
SLIGHT = 0.05  # success rates that differ by less are "slightly" different, or "competitive"
DISASTROUS = 0.10
LEAST_FRESH = 0.10  # of all grasps, from which on data are called on-policy
FEWEST_TRAININGS, FEWEST_SETTINGS = 6, 3  # from which on stability can be spoken of
MUCH_DATA = 1_000_000  # grasps, the most that the paper has


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
            one of its variants. A claim is not tested where a row that it speaks of is not there, lacks a run, as one
            diverged (those that are left are not a chance sample), or has one run alone.

    Raises:
        UserError: rows of one name or place are not those of one recipe and the same scenes, see `asked_rows`.
    """
    rows = asked_rows(table)
    return [*(claim(rows) for claim in CLAIMS), actor_unstable(trainings(table))]


def dql_best_in_low_data(rows: Rows) -> Judged:
    """Judge: DQL performs better in low-data regimes."""
    return _best_of(
        "DQL performs better than the others that learn values in low-data regimes",
        "`dql` against `mc`, `corr-mc`, `ddpg`, `pcl` at 10k, off-policy, on every task that was run (the paper has "
        "supervised learning do best there too); Holm, 5 %",
        _where(rows, size=10_000),
        ("dql",),
        ("mc", "corr-mc", "ddpg", "pcl"),
    )


def mc_best_at_1m(rows: Rows) -> Judged:
    """Judge: MC and corrected MC are best with much data on the targeted task."""
    return _best_of(
        "MC and Corr-MC are slightly better with much data on the targeted task",
        "`mc` and `corr-mc` each against `dql`, `supervised`, `ddpg` and `pcl` at 1M, targeted; Holm, 5 %",
        _where(rows, size=MUCH_DATA, task="targeted"),
        ("mc", "corr-mc"),
        ("dql", "supervised", "ddpg", "pcl"),
    )


def bias_of_mc(rows: Rows) -> Judged:
    """Judge: MC is a strong baseline although its target is biased off-policy."""
    return _within(
        "The bias of MC off-policy is not disastrous",
        f"`mc`, and `mc-discount0.9` where it was run, less `dql` and less `corr-mc`: every interval above "
        f"−{DISASTROUS:.2f} (one that is widened for their number below: fails)",
        _where(rows, ("mc", "dql", "corr-mc")),
        ("mc", "mc-discount0.9"),
        ("dql", "corr-mc"),
        DISASTROUS,
    )


def supervised_competitive(rows: Rows) -> Judged:
    """Judge: supervised learning is among the most successful given enough data."""
    return _within(
        "Supervised learning is competitive",
        f"`supervised` less `dql`, less `mc` and less `corr-mc`: every interval above −{SLIGHT:.2f} (one that is "
        "widened for their number below: fails)",
        _where(rows, ("supervised", "dql", "mc", "corr-mc")),
        ("supervised",),
        ("dql", "mc", "corr-mc"),
        SLIGHT,
    )


def on_policy_slight(rows: Rows) -> Judged:
    """Judge: on-policy data make a slight difference."""
    claim = "Off- and on-policy differ slightly, for all estimators"
    test = (
        "each of the six on-policy less off-policy at the same task, size and scenes, fresh grasps at least "
        f"{LEAST_FRESH:.0%} of the data: every interval within ±{SLIGHT:.2f} (one that is widened for their number "
        "outside: fails)"
    )
    both = {
        place: (here, rows.get(Place(place.task, place.size, "off-policy", place.split), {}))
        for place, here in rows.items()
        if place.setting == "on-policy" and place.split.startswith("test")
    }
    unready = "; ".join(filter(None, (_unready({place: one}, SIX) for place, way in both.items() for one in way)))
    if unready:
        return Judged(claim, test, "not tested", unready)
    pairs = [(here[name], there[name]) for here, there in both.values() for name in SIX]
    shares = [share for row, _ in pairs for share in _fresh_shares(row)]
    if shares and min(shares) < LEAST_FRESH:
        return Judged(claim, test, "not tested", f"of the data, {min(shares):.1%} are fresh grasps")
    return _judged(claim, test, [pairs], partial(_slight, margin=SLIGHT), "no row was scored both ways")


def _fresh_shares(row: Scored) -> list[float]:
    """Return how much of each run's data were grasps of its own policies."""
    fresh = [(one.get("fresh_grasps") or 0, parse_count(one["size"])) for one in row.rows]
    return [count / (count + base) for count, base in fresh]


def actor_worse(rows: Rows) -> Judged:
    """Judge: methods with an actor network are worse than those that search."""
    claim = "Methods with an actor network are worse than those with stochastic search"
    test = (
        "`ddpg` and `pcl` each against `dql`, `mc`, `corr-mc`, `supervised`; Holm, 5 %: all worse (any better: fails)"
    )
    places = _where(rows)
    unready = _unready(places, SIX)
    if unready:
        return Judged(claim, test, "not tested", unready)
    families = [list(itertools.product(_named(here, ACTOR), _named(here, SEARCH))) for here in places.values()]
    missing = "no row with an actor stands beside one that searches"
    return _judged(claim, test, families, _all_worse, missing, told=_not_worse)


def actor_unstable(found: Mapping[Place, Mapping[str, Sequence[tuple[str, float]]]]) -> Judged:
    """Judge: methods with an actor network, of which DDPG is tested, are unstable over hyperparameters."""
    claim = "An actor network, here DDPG's, makes training unstable over hyperparameters and seeds"
    test = (
        f"at least {FEWEST_TRAININGS} trainings of `ddpg`, and as many of each row that searches, over "
        f"{FEWEST_SETTINGS} settings or more, on any split: shortfalls (best rate less each) are larger with the "
        "actor, Mann-Whitney, one-sided, 5 %"
    )
    judged_at: list[tuple[int, Judged]] = []
    for place, here in found.items():
        # As many of each: the best of more trainings is better, and all fall shorter of it.
        count = max(len(here.get(ACTOR[0], ())), FEWEST_TRAININGS)
        swept = {
            algo: [rate for _, rate in some]
            for algo, some in here.items()
            if len({name for name, _ in some}) >= FEWEST_SETTINGS and len(some) == count
        }
        actor, search = (
            [max(rates) - rate for algo, rates in swept.items() if algo in group for rate in rates]
            for group in (ACTOR[:1], SEARCH)
        )
        if actor and search:
            p = float(scipy.stats.mannwhitneyu(actor, search, alternative="greater").pvalue)
            lower = float(scipy.stats.mannwhitneyu(actor, search, alternative="less").pvalue)
            verdict: Verdict = "holds" if p < 0.05 else "fails" if lower < 0.05 else "not decided"
            seen = (
                f"{place}: median shortfall {statistics.median(actor):.3f} of {len(actor)} with the actor, "
                f"{statistics.median(search):.3f} of {len(search)} that search; p {p:.3f}"
            )
            judged_at.append((len(actor) + len(search), Judged(claim, test, verdict, seen)))
    missing = f"no study here has {FEWEST_TRAININGS} trainings of either over {FEWEST_SETTINGS} settings"
    return max(judged_at, key=lambda one: one[0])[1] if judged_at else Judged(claim, test, "not tested", missing)


def ninety_percent(rows: Rows) -> Judged:
    """Judge: unseen objects are grasped with 90 % success."""
    claim = "Previously unseen objects are grasped with an average success rate of 90 %"
    test = (
        "regular task, test split: interval of a mean of one of the six, new seeds, scenes and objects, widened for "
        f"their number: ≥ 0.90 (all six below with the paper's {MUCH_DATA:,} grasps: fails)"
    )
    places = _where(rows, task="regular")
    scored = [(place, one) for place, here in places.items() for one in _named(here, SIX)]
    if not scored:
        return Judged(claim, test, "not tested", "no score on the test split")
    unready = _unready_rows([row for _, row in scored])
    if unready:
        return Judged(claim, test, "not tested", unready)
    place, row = max(scored, key=lambda one: one[1].mean.value)
    confidence = widened_confidence(len(scored))
    much = [here for one, here in places.items() if parse_count(one.size) >= MUCH_DATA]
    whole = any(all(name in here for name in SIX) for here in much)
    verdict: Verdict = "not decided"
    if any(one.mean_at(confidence).low >= 0.9 for _, one in scored):
        verdict = "holds"
    elif whole and all(one.mean.high < 0.9 for _, one in scored):
        verdict = "fails"
    seen = f"the best of {len(scored)}: {row.name} ({place}): {_interval(row)}, {len(row.rows)} seeds"
    return Judged(claim, test, verdict, seen)


CLAIMS: tuple[Callable[[Rows], Judged], ...] = (
    dql_best_in_low_data,
    mc_best_at_1m,
    bias_of_mc,
    on_policy_slight,
    actor_worse,
    supervised_competitive,
    ninety_percent,
)


def _where(rows: Rows, having: Sequence[str] = (), *, size: int | None = None, task: str | None = None) -> Rows:
    """Return the off-policy places on test objects with some of the six, of a size and task where they are given.

    Args:
        rows: of all places.
        having: rows that must be there.
        size: of the dataset.
        task: name of the task.
    """
    return {
        place: here
        for place, here in rows.items()
        if place.setting == "off-policy"
        and place.split.startswith("test")
        and any(name in here for name in SIX)
        and all(name in here for name in having)
        and size in (None, parse_count(place.size))
        and task in (None, place.task)
    }


def _named(here: Mapping[str, Scored], names: Sequence[str]) -> list[Scored]:
    return [here[name] for name in names if name in here]


def _unready(places: Rows, names: Sequence[str]) -> str:
    """Return which rows are not there or cannot be judged, in words; empty where all can be at all places."""
    missing = [f"`{name}`: not run ({place})" for place, here in places.items() for name in names if name not in here]
    unready = _unready_rows([row for here in places.values() for row in _named(here, names)])
    return "; ".join([*missing, *([unready] if unready else [])])


def _unready_rows(rows: Sequence[Scored]) -> str:
    """Return which rows lack trainings or have one alone, in words; empty where none does."""
    alone = "one training, which says nothing of another"
    found = ((row.name, row.lacking or ("" if row.several else alone)) for row in rows)
    return "; ".join(dict.fromkeys(f"`{name}`: {why}" for name, why in found if why))


def _judged(
    claim: str,
    test: str,
    families: Sequence[Sequence[tuple[Scored, Scored]]],
    decide: Callable[[Sequence[Compared]], Verdict],
    missing: str,
    told: Callable[[Sequence[Compared]], Sequence[Compared]] = list,
) -> Judged:
    """Return the verdict on pairs of rows, corrected within each family.

    Args:
        claim: what the paper says.
        test: what would have to be seen.
        families: the pairs of each place.
        decide: the verdict on all differences, of which there is at least one.
        missing: what to say where there is no pair.
        told: the differences to show.
    """
    found = [one for pairs in families for one in compare([pair for pair in pairs if pair[0].same_scenes(pair[1])])]
    if not found:
        return Judged(claim, test, "not tested", "no two rows met the same scenes" if any(families) else missing)
    return Judged(claim, test, decide(found), _list(told(found)))


def _slight(found: Sequence[Compared], margin: float) -> Verdict:
    if all(one.difference.low > -margin and one.difference.high < margin for one in found):
        return "holds"
    outside = any(one.widened.low > margin or one.widened.high < -margin for one in found)
    return "fails" if outside else "not decided"


def _not_below(found: Sequence[Compared], margin: float) -> Verdict:
    if all(one.difference.low > -margin for one in found):
        return "holds"
    return "fails" if any(one.widened.high < -margin for one in found) else "not decided"


def _all_better(found: Sequence[Compared]) -> Verdict:
    if any(one.worse for one in found):
        return "fails"
    return "holds" if all(one.better for one in found) else "not decided"


def _all_worse(found: Sequence[Compared]) -> Verdict:
    if any(one.better for one in found):
        return "fails"
    return "holds" if all(one.worse for one in found) else "not decided"


def _not_better(found: Sequence[Compared]) -> Sequence[Compared]:
    return [one for one in found if not one.better] or found


def _not_worse(found: Sequence[Compared]) -> Sequence[Compared]:
    return [one for one in found if not one.worse] or found


def _best_of(claim: str, test: str, places: Rows, winners: Sequence[str], others: Sequence[str]) -> Judged:
    unready = _unready(places, (*winners, *others))
    if unready:
        return Judged(claim, test, "not tested", unready)
    families = [list(itertools.product(_named(here, winners), _named(here, others))) for here in places.values()]
    missing = f"{' and '.join(winners)} were not scored there beside others"
    return _judged(claim, test, families, _all_better, missing, told=_not_better)


def _within(
    claim: str, test: str, places: Rows, candidates: Sequence[str], rivals: Sequence[str], margin: float
) -> Judged:
    unready = _unready_rows([row for here in places.values() for row in _named(here, (*candidates, *rivals))])
    if unready:
        return Judged(claim, test, "not tested", unready)
    families = [list(itertools.product(_named(here, candidates), _named(here, rivals))) for here in places.values()]
    missing = f"not all of {', '.join((*candidates, *rivals))} were scored together"
    return _judged(claim, test, families, partial(_not_below, margin=margin), missing)


def _interval(row: Scored) -> str:
    return f"{row.mean.value:.3f} ({row.mean.low:.3f} to {row.mean.high:.3f})"


def _list(found: Sequence[Compared]) -> str:
    return "; ".join(map(str, found))
