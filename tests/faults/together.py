"""Two commands on one folder at once: each comes to its end or refuses in a line, and the results are whole."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from tests.faults.commands import (
    DATAGEN,
    EVAL,
    OBJECTS,
    ONLINE,
    REPORT,
    STUDY,
    SWEEP,
    TRAIN,
    VERIFY,
    Line,
    Running,
    difference,
    essence,
    training,
)
from tests.faults.harness import Fault, Tried, Work

SMALLER = replace(DATAGEN, words=(DATAGEN.words[0], "16", *DATAGEN.words[2:]), made="")
# When the second starts, seconds after the first has begun to write; or with the first, so that they certainly meet.
DELAYS: dict[str, float | None] = {"at once": None, "0 s": 0.0, "0.4 s": 0.4, "1.2 s": 1.2}


@dataclass(frozen=True)
class Pair:
    """Two commands.

    Attributes:
        first: begins.
        second: begins with the first, or when that has begun to write, and a while after.
        grown: how the folder is made ready, from inputs: a command that runs before both.
        refused: whether the second must refuse if it meets the first.
    """

    first: Line
    second: Line
    grown: Line | None = None
    refused: bool = False


_EVAL_RUN = replace(EVAL, needs=("dataset",))
# Both may stand in one folder: it is the first's own place that must be as ever.
_EVAL_0 = replace(EVAL, result=f"{EVAL.result}/mc-regular-validation-seed0-4")
_OTHER_SEED = replace(OBJECTS, words=(*OBJECTS.words, "--seed", "7"), made="")
PAIRS = {
    "the same objects": Pair(OBJECTS, OBJECTS),
    "objects of two seeds": Pair(OBJECTS, _OTHER_SEED, refused=True),
    "one dataset twice": Pair(DATAGEN, DATAGEN),
    "one dataset in two sizes": Pair(DATAGEN, SMALLER),
    "a dataset grows and is grown": Pair(DATAGEN, DATAGEN, SMALLER),
    "a dataset and a training on it": Pair(DATAGEN, training("runs/beside")),
    "a dataset grows under a training": Pair(DATAGEN, training("runs/beside", steps=40), SMALLER),
    "a dataset grows under verify": Pair(DATAGEN, replace(VERIFY, needs=()), SMALLER),
    "a training twice": Pair(TRAIN, TRAIN),
    "trainings of two seeds": Pair(TRAIN, training(seed=1), refused=True),
    "a training and its evaluation": Pair(TRAIN, _EVAL_RUN),
    "a training and a report": Pair(TRAIN, Line(("grasp-report", "runs", "--out", "report.html"), ())),
    "an evaluation twice": Pair(EVAL, EVAL),
    "evaluations of two seeds": Pair(_EVAL_0, replace(EVAL, words=(*EVAL.words, "--seed", "1"), made="")),
    "a sweep twice": Pair(SWEEP, SWEEP),
    "a sweep and a report": Pair(SWEEP, Line(("grasp-report", "sweep", "--out", "report.html"), ())),
    "a study twice": Pair(STUDY, STUDY),
    "rounds twice": Pair(ONLINE, ONLINE),
    "a report twice": Pair(REPORT, REPORT),
}
SHORT = ("one dataset in two sizes",)


class Together:
    """Two commands at once."""

    name = "two commands on one folder"

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return each pair with each delay."""
        for pair in SHORT if short else PAIRS:
            for delay in ("0 s",) if short else DELAYS:
                yield Fault(self.name, PAIRS[pair].first.name, f"{pair}, {delay}")

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Run both, then the first again."""
        name, _, delay = fault.name.rpartition(", ")
        return _together(PAIRS[name], DELAYS[delay], work)


def _together(pair: Pair, delay: float | None, work: Work) -> Tried:
    needs = tuple(dict.fromkeys((*pair.first.needs, *pair.second.needs)))
    if pair.first.result == "data/regular-24":
        needs = pair.first.needs
    with replace(pair.first, needs=needs).case(work) as case:
        if pair.grown is not None:
            work.forked(pair.grown.words, case)
        first = Running(work, pair.first.words, case)
        if delay is not None:
            first.until(_writing(case / pair.first.result))
            time.sleep(delay)
        second = Running(work, pair.second.words, case)
        ended, met = first.ended(), second.ended()
        for ran in (ended, met):
            broken = ran.broken()
            if broken is not None:
                return broken
            if ran.rc != 0 and not ran.one_line:
                return Tried("lost", f"exit status {ran.rc}: {ran.line}")
        if ended.rc != 0 and met.rc != 0:
            return Tried("lost", f"both refused: {ended.line}; {met.line}")
        if pair.refused:
            # Whoever was first is whole.
            return _whole(pair, ended.rc, met.rc, case, work)
        after = pair.first.goes_on(case, work)
        if after.outcome == "survived" and pair.second.result == pair.first.result and pair.second.made:
            after = pair.second.goes_on(case, work)
        said = next((ran.line for ran in (ended, met) if ran.rc != 0), "")
        return after if after.outcome != "survived" or not said else Tried("detected", said)


def _whole(pair: Pair, first: int, second: int, case: Path, work: Work) -> Tried:
    if first == 0 and second == 0:
        return Tried("silently wrong", "both said that the folder is theirs")
    if first == 0:
        return pair.first.goes_on(case, work)
    there = essence(case / pair.second.result)
    again = work.forked(pair.second.words, case)
    changed = difference(essence(case / pair.second.result), there)
    return Tried("lost", again.line) if again.rc != 0 or changed is not None else Tried("detected")


def _writing(result: Path) -> Callable[[], bool]:
    return lambda: result.exists() or any(result.parent.glob(".tmp-*"))
