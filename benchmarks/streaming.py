"""What streaming from disk costs training: waiting for batches, and memory that grows.

python benchmarks/streaming.py --shards data/regular-10k
"""

import itertools
import statistics
import time
from dataclasses import dataclass
from functools import partial

from graspq.benchmarks.harness import (
    DataSettings,
    Ratio,
    Result,
    Row,
    alone,
    command,
    median_ratio,
    resident_bytes,
    take_turns,
    timed,
)
from graspq.benchmarks.loading import BATCH_SIZE, larger
from graspq.benchmarks.sessions import batches_of, ready, steps_on, training_of
from graspq.common.options import setting
from graspq.datasets.dataset import open_shards
from graspq.train.loop import update


@dataclass(frozen=True)
class StreamingSettings(DataSettings):
    """Settings of this benchmark."""

    steps: int = setting(20, help="Training steps in a turn.", minimum=1)
    memory_steps: int = setting(2400, help="Training steps while memory is watched.", minimum=8)


def waiting_row(algo: str, settings: StreamingSettings) -> Row:
    """Return what a training step on streamed batches waits for them, and how much slower it is than on ready ones."""
    pool = open_shards(settings.shards)
    wide, buffer_bytes = larger(pool.split(0.05, 0)[0], BATCH_SIZE)
    waits: list[float] = []
    with (
        training_of(algo, settings.shards, pool, buffer_bytes=buffer_bytes, batch_size=BATCH_SIZE) as current,
        batches_of(current, wide) as batches,
    ):
        lying = list(itertools.islice(itertools.cycle(ready(current, wide, 4)), settings.steps))

        def streamed(turn: int) -> float:
            for batch in itertools.islice(batches, 3):  # those that were fetched meanwhile
                update(current, batch)["loss"].item()
            start, waited = time.perf_counter(), 0.0
            for _ in range(settings.steps):
                before = time.perf_counter()
                batch = next(batches)
                waited += time.perf_counter() - before
                update(current, batch)["loss"].item()
            waits.append(waited / settings.steps)
            return (time.perf_counter() - start) / settings.steps

        arms = {"ready": timed(steps_on(lying, partial(update, current)), settings.steps), "streamed": streamed}
        seconds = take_turns(arms, settings.turns)
    return {
        "estimator": algo,
        "step, ms": 1e3 * statistics.median(seconds["streamed"]),
        "share of waiting": median_ratio(waits[1:], seconds["streamed"]),  # but for the turn that warms up
        "times a step on ready batches": median_ratio(seconds["streamed"], seconds["ready"]),
    }


def memory_row(settings: StreamingSettings) -> Row:
    """Return the resident memory of this process while it trains `mc` on streamed batches."""
    pool = open_shards(settings.shards)
    wide, buffer_bytes = larger(pool.split(0.05, 0)[0], BATCH_SIZE)
    seen = []
    with (
        training_of("mc", settings.shards, pool, buffer_bytes=buffer_bytes, batch_size=BATCH_SIZE) as current,
        batches_of(current, wide) as batches,
    ):
        for batch in itertools.islice(batches, settings.memory_steps):
            update(current, batch)
            seen.append(resident_bytes() / 1e6)
    quarter = len(seen) // 4
    early, late = statistics.mean(seen[quarter : 2 * quarter]), statistics.mean(seen[-quarter:])
    return {
        "epochs": settings.memory_steps * BATCH_SIZE / wide.rows,
        "buffer, MB": buffer_bytes / 1e6,
        "second quarter, MB": early,
        "last quarter, MB": late,
        "growth": late / early - 1,
    }


def measure(settings: StreamingSettings) -> Result:
    """Return what `mc` and `dql` wait for, and the memory of `mc`."""
    mc, dql = (waiting_row(algo, settings) for algo in ("mc", "dql"))
    memory = alone(memory_row, settings)
    says = "share of a training step spent waiting for data, `mc`"
    against = "a step of `mc` on streamed batches, against one on batches that lie ready"
    growth = "growth of the memory of streaming training, data ten times the buffer"
    return Result(
        [
            Ratio(says, mc["share of waiting"], bar=0.05, aim=0.01, is_share=True),
            Ratio("… `dql`", dql["share of waiting"], bar=0.05, aim=0.01, is_share=True),
            Ratio(against, mc["times a step on ready batches"]),
            Ratio(growth, memory["growth"], bar=0.02, is_share=True),
        ],
        {"Waiting for data in training": [mc, dql], "Resident memory of streaming `mc`": [memory]},
    )


main = command(StreamingSettings, measure)


if __name__ == "__main__":
    main()
