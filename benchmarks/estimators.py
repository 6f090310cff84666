"""Training speed of every estimator against `mc`: real transitions a second, padding not counted.

python benchmarks/estimators.py --shards data/regular-10k
"""

import contextlib
from dataclasses import dataclass

from graspq.benchmarks.measuring import Ratio, Result, TrainingSpeedSettings, command, compared, take_turns
from graspq.benchmarks.sessions import ready, steps_on, training_of, update_of
from graspq.common.options import setting
from graspq.datasets.dataset import open_shards
from graspq.train.estimators import ESTIMATORS


@dataclass(frozen=True)
class EstimatorsSettings(TrainingSpeedSettings):
    """Settings of this benchmark."""

    steps: int = setting(6, help="Steps of each estimator in a turn.", minimum=1)


def measure(settings: EstimatorsSettings) -> Result:
    """Return the speed of each estimator of the table."""
    pool = open_shards(settings.shards)
    runs, real = {}, {}
    with contextlib.ExitStack() as stack:
        for name in ESTIMATORS:
            current = stack.enter_context(training_of(name, pool, settings))
            batches = ready(current, pool, settings.steps)
            runs[name] = steps_on(batches, update_of(current))
            real[name] = sum(int(batch.real_steps.sum()) for batch in batches)
        seconds = take_turns(runs, settings.turns)
    rows, times = compared("estimator", "transitions", seconds, real, "mc")
    return Result(
        [
            Ratio("transitions a second of `dql`, against `mc`", times["dql"], bar=0.5),
            Ratio("… of `corr-mc`", times["corr-mc"], bar=0.4),
        ],
        {"Training speed of the estimators": rows},
    )


main = command(EstimatorsSettings, measure)


if __name__ == "__main__":
    main()
