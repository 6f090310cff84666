"""Thousands of drawn command lines, manifests, object sets, headers of shards, runs and plans: never a traceback.

Each fault is a batch of cases that hypothesis draws from a seed, in one forked child: see `fuzz_cases`.
"""

from collections.abc import Iterable

from tests.faults.harness import HERE, Fault, Tried, Work
from tests.faults.hostile import limits

BATCH = 250
# Target -> batches. 85 x 250 cases are 21,250.
TARGETS = {"command line": 25, "manifest": 15, "object set": 15, "shard header": 10, "run": 15, "plan": 5}
COMMANDS = {
    "command line": "all",
    "manifest": "grasp-data",
    "object set": "grasp-objects",
    "shard header": "grasp-train",
    "run": "grasp-eval",
    "plan": "grasp-study",
}


class Fuzz:
    """The kind."""

    name = "fuzz"

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return the batches; a small one of one target in the short form."""
        for target, batches in TARGETS.items():
            if short:
                if target == "manifest":
                    yield Fault(self.name, COMMANDS[target], f"{target}, seed 0, 20 cases")
            else:
                for seed in range(batches):
                    yield Fault(self.name, COMMANDS[target], f"{target}, seed {seed}, {BATCH} cases")

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Let a child draw and try the batch; what it says of a case that failed is the fault's."""
        target, seed, cases = fault.name.split(", ")
        count = cases.split()[0]
        with work.copy("objects", "dataset", "run", "evaluation") as case:
            words = [HERE / "fuzz_cases.py", target, seed.split()[1], count]
            ran = work.forked(words, case, seconds=1200, limits=limits(work))
        broken = ran.broken()
        if broken is not None:
            return Tried(broken.outcome, ran.stderr[-1500:], int(count))
        if ran.rc != 0:
            return Tried("silently wrong", ran.stderr[-1500:], int(count))
        return Tried("detected", ran.stdout.strip(), int(count))
