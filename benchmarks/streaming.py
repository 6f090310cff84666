"""What streaming from disk costs training, in waiting and in memory: a part of `loading.py`.

"Streaming" is reading through a buffer that holds a tenth of the data, as with data larger than memory.
"""

import contextlib
import itertools
import multiprocessing
import statistics
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from memory import resident_bytes
from sessions import default_settings
from timing import median_ratio

from graspq.common.errors import UserError
from graspq.datasets.dataset import open_shards
from graspq.datasets.pool import ShardPool
from graspq.datasets.sampler import Sampler
from graspq.train.batches import training_batches
from graspq.train.loop import Session, session

TIMES = 10
CPU = torch.device("cpu")


def larger(pool: ShardPool, batch_size: int) -> tuple[ShardPool, int]:
    """Return the pool with its blocks named so often that a tenth of it is enough as a buffer, and those bytes."""
    for copies in itertools.count(1):
        blocks = pool.blocks * copies
        rows = sum(ref.rows for ref in blocks) // TIMES
        with contextlib.suppress(UserError):
            Sampler([ref.rows for ref in blocks], batch_size, 0, rows)
            return replace(pool, blocks=blocks), rows * pool.row_bytes
    raise AssertionError


def waiting_row(current: Session, pool: ShardPool, steps: int, turns: int) -> dict[str, Any]:
    """Return what a training step on streamed batches waits for them, and how much slower it is than on ready ones."""
    waits, totals, readies = [], [], []
    pool = pool.with_discount(current.discount)
    with training_batches(pool, current.settings, current.estimator, CPU, 0) as batches:
        ready = list(itertools.islice(batches, 4))
        for turn in range(turns + 1):
            start = time.perf_counter()
            for batch in itertools.islice(itertools.cycle(ready), steps):
                current.update(batch).item()
            seconds = time.perf_counter() - start
            # Those that were fetched while the ready ones were trained on.
            for _ in range(3):
                current.update(next(batches)).item()
            start, waited = time.perf_counter(), 0.0
            for _ in range(steps):
                before = time.perf_counter()
                batch = next(batches)
                waited += time.perf_counter() - before
                current.update(batch).item()
            if turn > 0:
                readies.append(seconds)
                waits.append(waited)
                totals.append(time.perf_counter() - start)
    return {
        "estimator": current.settings.algo,
        "step, ms": 1e3 * statistics.median(totals) / steps,
        "waiting, ms": 1e3 * statistics.median(waits) / steps,
        "share of waiting": median_ratio(waits, totals),
        "times a step on ready batches": median_ratio(totals, readies),
    }


def waiting_rows(
    shards: tuple[str, ...], pool: ShardPool, steps: int, turns: int, threads: int | None
) -> Iterator[dict[str, Any]]:
    """Yield a row for `mc` and for `dql`."""
    kept, held_back = pool.split(0.05, 0)
    with tempfile.TemporaryDirectory() as folder:
        for algo in ("mc", "dql"):
            settings = default_settings(algo, shards, Path(folder) / algo, threads)
            wide, buffer_bytes = larger(kept, settings.batch_size)
            settings = replace(settings, buffer_bytes=buffer_bytes)
            with session(settings, pool, kept, held_back) as current:
                yield waiting_row(current, wide, steps, turns)


def _memory_of_training(shards: tuple[str, ...], steps: int, threads: int | None) -> dict[str, Any]:
    pool = open_shards(shards)
    kept, held_back = pool.split(0.05, 0)
    start, seen = resident_bytes() / 2**20, []
    with tempfile.TemporaryDirectory() as folder:
        settings = default_settings("mc", shards, Path(folder) / "mc", threads)
        wide, buffer_bytes = larger(kept, settings.batch_size)
        settings = replace(settings, buffer_bytes=buffer_bytes)
        with session(settings, pool, kept, held_back) as current:
            wide = wide.with_discount(current.discount)
            with training_batches(wide, settings, current.estimator, CPU, 0) as batches:
                for batch in itertools.islice(batches, steps):
                    current.update(batch)
                    seen.append(resident_bytes() / 2**20)
    quarter = max(1, len(seen) // 4)
    early, late = statistics.mean(seen[quarter : 2 * quarter]), statistics.mean(seen[-quarter:])
    return {
        "training": "mc",
        "steps": steps,
        "data over buffer": wide.rows * pool.row_bytes / buffer_bytes,
        "epochs": steps * settings.batch_size / wide.rows,
        "buffer, MiB": buffer_bytes / 2**20,
        "before, MiB": start,
        "second quarter, MiB": early,
        "last quarter, MiB": late,
        "most, MiB": max(seen),
        "growth": late / early - 1,
    }


def memory_row(shards: tuple[str, ...], steps: int, threads: int | None) -> dict[str, Any]:
    """Return the resident memory of streaming training in a process of its own."""
    with multiprocessing.get_context("spawn").Pool(1) as process:
        row: dict[str, Any] = process.apply(_memory_of_training, (shards, steps, threads))
        return row
