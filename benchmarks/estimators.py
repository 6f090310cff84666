"""Training speed of every estimator against `mc`: real transitions a second, padding not counted.

python benchmarks/estimators.py --shards data/regular-10k
"""

import contextlib
from dataclasses import dataclass
from functools import partial

from graspq.benchmarks.harness import DataSettings, Ratio, Result, command, compared, median_ratio, take_turns, timed
from graspq.benchmarks.sessions import ready, steps_on, training_of
from graspq.common.options import setting
from graspq.datasets.dataset import open_shards
from graspq.train.estimators import ESTIMATORS
from graspq.train.loop import update


@dataclass(frozen=True)
class EstimatorsSettings(DataSettings):
    """Settings of this benchmark."""

    steps: int = setting(6, help="Steps of each estimator in a turn.", minimum=1)


def measure(settings: EstimatorsSettings) -> Result:
    """Return the speed of each estimator of the table."""
    pool, arms = open_shards(settings.shards), {}
    with contextlib.ExitStack() as stack:
        for name in ESTIMATORS:
            current = stack.enter_context(training_of(name, settings.shards, pool))
            batches = ready(current, pool, settings.steps)
            real = sum(int(batch.real_steps.sum()) for batch in batches)
            arms[name] = timed(steps_on(batches, partial(update, current)), real)
        seconds = take_turns(arms, settings.turns)
    return Result(
        [
            Ratio("transitions a second of `dql`, against `mc`", median_ratio(seconds["mc"], seconds["dql"]), bar=0.5),
            Ratio("… of `corr-mc`", median_ratio(seconds["mc"], seconds["corr-mc"]), bar=0.4),
        ],
        {"Training speed of the estimators": compared("estimator", "transition", seconds, "mc")},
    )


main = command(EstimatorsSettings, measure)


if __name__ == "__main__":
    main()
