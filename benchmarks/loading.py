"""Shuffled transitions (s, a, r, s') from disk, a second, against usual ways to read them.

    python benchmarks/loading.py --shards data/regular-10k

Without Hugging Face `datasets` only PNG files are read.
"""

import contextlib
import itertools
import tempfile
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch

from graspq.benchmarks import loading_rivals as rivals
from graspq.benchmarks.harness import DataSettings, Ratio, Result, command, compared, median_ratio, take_turns, timed
from graspq.benchmarks.sessions import CPU
from graspq.common.errors import UserError
from graspq.common.options import setting
from graspq.datasets.dataset import open_shards
from graspq.datasets.pool import ShardPool
from graspq.datasets.sampler import Sampler
from graspq.train.batch import to_tensors

BATCH_SIZE = 256
TIMES = 10  # the data over the buffer, in streaming
STREAMING, CHECKED = "graspq, streaming", "graspq, streaming, SHA-256 of all files first"
IN_MEMORY = "graspq, all in the buffer, first epoch"
PNG = "PNG files, PyTorch DataLoader"
HF_MAP, HF_STREAM = "Hugging Face datasets, map-style", "Hugging Face datasets, streaming"
LEROBOT = "LeRobot-style random access"
RIVALS: dict[str, Callable[[rivals.Frames, Path, int], rivals.Epoch]] = {
    PNG: rivals.shuffled(rivals.PngFiles),
    HF_MAP: rivals.shuffled(rivals.MapStyleRows),
    HF_STREAM: rivals.hugging_face_stream,
    LEROBOT: rivals.shuffled(rivals.LeRobotRows),
}


@dataclass(frozen=True)
class LoadingSettings(DataSettings):
    """Settings of this benchmark."""

    batch_size: int = setting(BATCH_SIZE, help="Transitions of a batch.", minimum=2)
    rival_batches: int | None = setting(None, help="The rivals' batches; an epoch if not given.", minimum=1)


def larger(pool: ShardPool, batch_size: int) -> tuple[ShardPool, int]:
    """Return the pool with its blocks named so often that a tenth of it is enough as a buffer, and those bytes."""
    for copies in itertools.count(1):
        blocks = pool.blocks * copies
        rows = sum(ref.rows for ref in blocks) // TIMES
        with contextlib.suppress(UserError):
            Sampler([ref.rows for ref in blocks], batch_size, 0, rows)
            return replace(pool, blocks=blocks), rows * pool.row_bytes
    raise AssertionError


def consume(epoch: Callable[[], Iterable[Any]], count: int, slack: int = 0) -> None:
    """Take `count` batches of a new epoch; `UserError` where it lacks more than `slack` of them."""
    taken = sum(1 for _ in itertools.islice(epoch(), count))
    if taken < count - slack:
        raise UserError(f"a rival's epoch ended after {taken} batches, expected {count}: ask for fewer")


def ours(open_pool: Callable[[], ShardPool], batch_size: int, batches: int, buffer_bytes: int) -> None:
    """Open a pool and take so many batches with s' from it as tensors."""
    with open_pool().batches(batch_size, buffer_bytes=buffer_bytes) as loader:
        consume(lambda: (to_tensors(batch, CPU) for batch in loader), batches)


def known(frames: rivals.Frames) -> dict[tuple[int, bytes], int]:
    """Return which picture follows on each picture and action, by checksum."""
    sums = [zlib.crc32(picture.tobytes()) for picture in frames.pictures()]
    actions = frames.columns["action"]
    return {(sums[row], actions[row].tobytes()): sums[next_row] for row, next_row in enumerate(frames.next_row)}


def check(name: str, epoch: rivals.Epoch, transitions: dict[tuple[int, bytes], int]) -> None:
    """Refuse a rival whose first batch is not of transitions of the data (`UserError`)."""

    def checksum(picture: torch.Tensor) -> int:
        if picture.is_floating_point():
            picture = (picture.permute(1, 2, 0) * 255).round().to(torch.uint8)
        return zlib.crc32(np.ascontiguousarray(picture.numpy()).tobytes())

    batch = next(iter(epoch()))
    for image, following, action in zip(batch["image"], batch["next_image"], batch["action"], strict=True):
        found = transitions.get((checksum(image), action.numpy().astype(np.float32).tobytes()))
        if found != checksum(following):
            raise UserError(f"{name}: gives a transition that is not in the data")


def measure(settings: LoadingSettings) -> Result:
    """Return samples a second of ours and of the rivals."""
    pool, size = open_shards(settings.shards), settings.batch_size
    batches = pool.rows // size
    wide, buffer_bytes = larger(pool, size)
    readers = {
        STREAMING: partial(ours, lambda: wide, size, batches, buffer_bytes),
        CHECKED: partial(ours, lambda: larger(open_shards(settings.shards), size)[0], size, batches, buffer_bytes),
        IN_MEMORY: partial(ours, lambda: pool, size, batches, 2 * pool.rows * pool.row_bytes),
    }
    arms = {name: timed(read, size * batches) for name, read in readers.items()}
    frames, rival_batches = rivals.Frames(pool), settings.rival_batches or batches
    transitions = known(frames)
    with tempfile.TemporaryDirectory(prefix="graspq-loading-") as scratch:
        for name, make in RIVALS.items():
            try:
                epoch = make(frames, Path(scratch) / name.replace(" ", "-"), size)
            except ImportError as error:
                click.echo(f"{name}: left out ({error})", err=True)
                continue
            check(name, epoch, transitions)
            # Each worker's last batch may be too small to count.
            arms[name] = timed(partial(consume, epoch, rival_batches, rivals.WORKERS), size * rival_batches)
        seconds = take_turns(arms, settings.turns)

    def times(name: str) -> float | None:
        return median_ratio(seconds[PNG], seconds[name]) if name in seconds else None

    return Result(
        [
            Ratio("shuffled transitions from disk, against PNG + `DataLoader`", times(STREAMING), bar=10, aim=30),
            Ratio("… every file's SHA-256 checked first", times(CHECKED)),
            Ratio("… with all data in the buffer, first epoch", times(IN_MEMORY), bar=10, aim=30),
            Ratio("Hugging Face `datasets`, map-style", times(HF_MAP)),
            Ratio("Hugging Face `datasets`, streaming", times(HF_STREAM)),
            Ratio("LeRobot-style random access", times(LEROBOT)),
        ],
        {"Loading shuffled transitions with s' from disk": compared("loader", "sample", seconds, PNG)},
        {"streaming buffer, bytes": buffer_bytes},
    )


main = command(LoadingSettings, measure)


if __name__ == "__main__":
    main()
