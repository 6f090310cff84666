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
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch

from graspq.benchmarks import loading_rivals as rivals
from graspq.benchmarks.measuring import Ratio, Result, TrainingSpeedSettings, command, compared, take_turns
from graspq.common.errors import UserError
from graspq.common.options import setting
from graspq.datasets.dataset import open_shards
from graspq.datasets.pool import ShardPool
from graspq.datasets.sampler import Sampler
from graspq.train.batch import to_tensors

TIMES = 10  # the data over the buffer, in streaming
STREAMING, CHECKED = "graspq, streaming", "graspq, streaming, SHA-256 of all files first"
IN_MEMORY = "graspq, all in the buffer, first epoch"
PNG = "PNG files, PyTorch DataLoader"
RIVALS: dict[str, Callable[[rivals.Frames, Path, int, int], rivals.Epoch]] = {
    PNG: rivals.png_files,
    "Hugging Face datasets, map-style": rivals.hugging_face_map,
    "Hugging Face datasets, streaming": rivals.hugging_face_stream,
    "LeRobot-style random access": rivals.lerobot_style,
}
CPU = torch.device("cpu")


@dataclass(frozen=True)
class LoadingSettings(TrainingSpeedSettings):
    """Settings of this benchmark."""

    batch_size: int = setting(256, help="Transitions of a batch.", minimum=2)
    workers: int = setting(2, help="Worker processes of each rival.", minimum=0)
    rival_batches: int | None = setting(None, help="The rivals' batches; an epoch if not given.", minimum=1)
    scratch: Path | None = setting(None, help="Folder to keep the rivals' copies of the data in.")


def larger(pool: ShardPool, batch_size: int) -> tuple[ShardPool, int]:
    """Return the pool with its blocks named so often that a tenth of it is enough as a buffer, and those bytes."""
    for copies in itertools.count(1):
        blocks = pool.blocks * copies
        rows = sum(ref.rows for ref in blocks) // TIMES
        with contextlib.suppress(UserError):
            Sampler([ref.rows for ref in blocks], batch_size, 0, rows)
            return replace(pool, blocks=blocks), rows * pool.row_bytes
    raise AssertionError


def consume(batches: Iterable[Any], count: int, slack: int = 0) -> None:
    """Take `count` batches.

    Raises:
        UserError: the epoch lacks more than `slack` of them.
    """
    taken = sum(1 for _ in itertools.islice(batches, count))
    if taken < count - slack:
        raise UserError(f"a rival's epoch ended after {taken} batches, expected {count}: ask for fewer")


def epoch_of(epoch: rivals.Epoch, batches: int, slack: int) -> Callable[[], None]:
    """Return what takes so many batches of a rival's epoch."""
    return lambda: consume(epoch(), batches, slack)


def ours(open_pool: Callable[[], ShardPool], batch_size: int, batches: int, buffer_bytes: int) -> Callable[[], None]:
    """Return what opens a pool and takes so many batches with s' from it as tensors."""

    def read() -> None:
        with open_pool().batches(batch_size, buffer_bytes=buffer_bytes) as loader:
            consume((to_tensors(batch, CPU) for batch in loader), batches)

    return read


def known(frames: rivals.Frames) -> dict[tuple[int, bytes], int]:
    """Return which picture follows on each picture and action, by checksum."""
    sums = [zlib.crc32(picture.tobytes()) for picture in frames.pictures()]
    actions = frames.columns["action"]
    return {(sums[row], actions[row].tobytes()): sums[next_row] for row, next_row in enumerate(frames.next_row)}


def check(name: str, epoch: rivals.Epoch, transitions: dict[tuple[int, bytes], int]) -> None:
    """Refuse a rival whose first batch is not of transitions of the data.

    Raises:
        UserError: it is not.
    """

    def checksum(picture: torch.Tensor) -> int:
        if picture.is_floating_point():
            picture = (picture.permute(1, 2, 0) * 255).round().to(torch.uint8)
        return zlib.crc32(np.ascontiguousarray(picture.numpy()).tobytes())

    batch = next(iter(epoch()))
    for image, following, action in zip(batch["image"], batch["next_image"], batch["action"], strict=True):
        found = transitions.get((checksum(image), action.numpy().astype(np.float32).tobytes()))
        if found != checksum(following):
            raise UserError(f"{name}: gives a transition that is not in the data")


def rival_runs(pool: ShardPool, folder: Path, batches: int, settings: LoadingSettings) -> dict[str, Callable[[], None]]:
    """Make the rivals' copies of the data and return what reads `batches` of them."""
    frames = rivals.Frames(pool)
    transitions = known(frames)
    runs: dict[str, Callable[[], None]] = {}
    for name, make in RIVALS.items():
        try:
            epoch = make(frames, folder / name.replace(" ", "-"), settings.batch_size, settings.workers)
        except ImportError as error:
            click.echo(f"{name}: left out ({error})", err=True)
            continue
        check(name, epoch, transitions)
        # Each worker's last batch may be too small to count.
        runs[name] = epoch_of(epoch, batches, settings.workers)
    return runs


def measure(settings: LoadingSettings) -> Result:
    """Return samples a second of ours and of the rivals."""
    pool = open_shards(settings.shards)
    size = settings.batch_size
    batches = pool.rows // size
    rival_batches = settings.rival_batches or batches
    wide, buffer_bytes = larger(pool, size)
    runs = {
        STREAMING: ours(lambda: wide, size, batches, buffer_bytes),
        CHECKED: ours(lambda: larger(open_shards(settings.shards), size)[0], size, batches, buffer_bytes),
        IN_MEMORY: ours(lambda: pool, size, batches, 2 * pool.rows * pool.row_bytes),
    }
    counts = dict.fromkeys(runs, size * batches) | dict.fromkeys(RIVALS, size * rival_batches)
    with tempfile.TemporaryDirectory(prefix="graspq-loading-") as temporary:
        runs |= rival_runs(pool, settings.scratch or Path(temporary), rival_batches, settings)
        seconds = take_turns(runs, settings.turns)
    rows, times = compared("loader", "samples", seconds, counts, PNG)
    return Result(
        [
            Ratio("shuffled transitions from disk, against PNG + `DataLoader`", times[STREAMING], bar=10, aim=30),
            Ratio("… every file's SHA-256 checked first", times[CHECKED]),
            Ratio("… with all data in the buffer, first epoch", times[IN_MEMORY], bar=10, aim=30),
            Ratio("Hugging Face `datasets`, map-style", times.get("Hugging Face datasets, map-style")),
            Ratio("Hugging Face `datasets`, streaming", times.get("Hugging Face datasets, streaming")),
            Ratio("LeRobot-style random access", times.get("LeRobot-style random access")),
        ],
        {"Loading shuffled transitions with s' from disk": rows},
        {"streaming buffer, bytes": buffer_bytes},
    )


main = command(LoadingSettings, measure)


if __name__ == "__main__":
    main()
