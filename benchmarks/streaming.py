"""What streaming from disk costs training: waiting for batches, and memory that grows.

python benchmarks/streaming.py --shards data/regular-10k
"""

import itertools
import statistics
import time
from dataclasses import dataclass

from graspq.benchmarks.loading import TIMES, larger
from graspq.benchmarks.measuring import (
    Call,
    Ratio,
    Result,
    Row,
    TrainingSpeedSettings,
    apart,
    command,
    median_ratio,
    resident_bytes,
)
from graspq.benchmarks.sessions import batches_of, ready, steps_on, training_of, update_of
from graspq.common.options import setting
from graspq.datasets.dataset import open_shards
from graspq.datasets.pool import ShardPool


@dataclass(frozen=True)
class StreamingSettings(TrainingSpeedSettings):
    """Settings of this benchmark."""

    steps: int = setting(20, help="Training steps in a turn.", minimum=1)
    memory_steps: int = setting(2400, help="Training steps while memory is watched.", minimum=8)


def waiting_row(algo: str, pool: ShardPool, settings: StreamingSettings) -> Row:
    """Return what a training step on streamed batches waits for them, and how much slower it is than on ready ones."""
    waits, totals, readies = [], [], []
    wide, buffer_bytes = larger(pool.split(0.05, 0)[0], 256)
    with training_of(algo, pool, settings, buffer_bytes=buffer_bytes, batch_size=256) as current:
        update = update_of(current)
        lying = ready(current, wide, 4)
        on_ready = steps_on(list(itertools.islice(itertools.cycle(lying), settings.steps)), update)
        with batches_of(current, wide) as batches:
            for turn in range(settings.turns + 1):
                start = time.perf_counter()
                on_ready()
                ready_seconds = time.perf_counter() - start
                steps_on([next(batches) for _ in range(3)], update)()  # those that were fetched meanwhile
                start, waited = time.perf_counter(), 0.0
                for _ in range(settings.steps):
                    before = time.perf_counter()
                    batch = next(batches)
                    waited += time.perf_counter() - before
                    update(batch).item()
                if turn > 0:
                    readies.append(ready_seconds)
                    waits.append(waited)
                    totals.append(time.perf_counter() - start)
    return {
        "estimator": algo,
        "step, ms": 1e3 * statistics.median(totals) / settings.steps,
        "waiting, ms": 1e3 * statistics.median(waits) / settings.steps,
        "share of waiting": median_ratio(waits, totals),
        "times a step on ready batches": median_ratio(totals, readies),
    }


def memory_row(settings: StreamingSettings) -> Row:
    """Return the resident memory of this process while it trains `mc` on streamed batches."""
    pool = open_shards(settings.shards)
    wide, buffer_bytes = larger(pool.split(0.05, 0)[0], 256)
    start, seen = resident_bytes() / 1e6, []
    with (
        training_of("mc", pool, settings, buffer_bytes=buffer_bytes, batch_size=256) as current,
        batches_of(current, wide) as batches,
    ):
        for batch in itertools.islice(batches, settings.memory_steps):
            current.update(batch)
            seen.append(resident_bytes() / 1e6)
    quarter = len(seen) // 4
    early, late = statistics.mean(seen[quarter : 2 * quarter]), statistics.mean(seen[-quarter:])
    return {
        "steps": settings.memory_steps,
        "epochs": settings.memory_steps * 256 / wide.rows,
        "data over buffer": TIMES,
        "buffer, MB": buffer_bytes / 1e6,
        "before, MB": start,
        "second quarter, MB": early,
        "last quarter, MB": late,
        "most, MB": max(seen),
        "growth": late / early - 1,
    }


def measure(settings: StreamingSettings) -> Result:
    """Return what `mc` and `dql` wait for, and the memory of `mc`."""
    pool = open_shards(settings.shards)
    rows = {algo: waiting_row(algo, pool, settings) for algo in ("mc", "dql")}
    (memory,) = apart([Call(memory_row, (settings,))])
    share = "share of a training step spent waiting for data, `mc`"
    return Result(
        [
            Ratio(share, rows["mc"]["share of waiting"], bar=0.05, aim=0.01, is_share=True),
            Ratio("… `dql`", rows["dql"]["share of waiting"], bar=0.05, aim=0.01, is_share=True),
            Ratio(
                "a step of `mc` on streamed batches, against one on batches that lie ready",
                rows["mc"]["times a step on ready batches"],
            ),
            Ratio(
                "growth of the memory of streaming training, data ten times the buffer",
                memory["growth"],
                bar=0.02,
                is_share=True,
            ),
        ],
        {"Waiting for data in training": list(rows.values()), "Resident memory of streaming `mc`": [memory]},
    )


main = command(StreamingSettings, measure)


if __name__ == "__main__":
    main()
