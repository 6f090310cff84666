"""The same command in other ways that must not matter: the same bytes of data, the same scores, the same weights."""

from collections.abc import Iterable

from tests.faults.commands import EVAL, SWEEP, TRAIN, Line
from tests.faults.harness import Fault, Tried, Work
from tests.faults.workers import COLLECT

# Command, what is another → how it is called: words that take the place of others, and variables.
WAYS: dict[tuple[str, str], tuple[Line, dict[str, str], dict[str, str]]] = {
    ("grasp-datagen", "no workers"): (COLLECT, {"--workers": "0"}, {}),
    ("grasp-datagen", "one worker"): (COLLECT, {}, {}),
    ("grasp-datagen", "three workers"): (COLLECT, {"--workers": "3"}, {}),
    ("grasp-datagen", "three threads"): (COLLECT, {}, {"OMP_NUM_THREADS": "3", "NUMBA_NUM_THREADS": "3"}),
    ("grasp-datagen", "another hash seed"): (COLLECT, {}, {"PYTHONHASHSEED": "12"}),
    ("grasp-eval", "one worker"): (EVAL, {"--workers": "1"}, {}),
    ("grasp-eval", "three workers"): (EVAL, {"--workers": "3"}, {}),
    ("grasp-eval", "three threads"): (EVAL, {}, {"OMP_NUM_THREADS": "3", "MKL_NUM_THREADS": "3"}),
    ("grasp-eval", "another hash seed"): (EVAL, {}, {"PYTHONHASHSEED": "12"}),
    ("grasp-sweep", "one worker"): (SWEEP, {"--workers": "1"}, {}),
    ("grasp-train", "a second time"): (TRAIN, {}, {}),
    ("grasp-train", "another hash seed"): (TRAIN, {}, {"PYTHONHASHSEED": "12"}),
    ("grasp-train", "OMP_NUM_THREADS beside --threads"): (TRAIN, {}, {"OMP_NUM_THREADS": "3"}),
    ("grasp-train", "--verify-replay"): (
        Line(("grasp-train", "--verify-replay", "runs/mc"), ("dataset", "run")), {}, {},
    ),
}  # fmt: skip


class Reproducible:
    """Not faults, but what must be none."""

    name = "reproducibility"

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return each way."""
        for command, way in [("grasp-train", "--verify-replay")] if short else WAYS:
            yield Fault(self.name, command, way)

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Run it that way, and compare with the usual one."""
        line, changed, env = WAYS[fault.command, fault.name]
        words = list(line.words)
        for option, value in changed.items():
            words[words.index(option) + 1] = value
        work.made("objects")
        with line.case(work) as case:
            ran = work.run(words, case, env=env) if env else work.forked(words, case)
            broken = ran.broken()
            if broken is not None or ran.rc != 0:
                return broken or Tried("lost", ran.line)
            if fault.name == "--verify-replay" and "same bit for bit" not in ran.stdout:
                return Tried("silently wrong", ran.stdout.strip())
            return line.fits(case, work, ran)
