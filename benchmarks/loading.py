"""Loading from disk: shuffled transitions (s, a, r, s') a second against usual ways, and what loading costs training.

    python benchmarks/loading.py --shards data/regular-10k

What is timed is a whole epoch from the making of the loader on, the start of worker processes included. Every sample
of a rival's first batch is looked up in the data. Pages are in the system's cache for all. Ours runs in one process: a
thread gathers batches, and as many threads as there are cores, four at most, read blocks. "Streaming" reads every block
from disk in every epoch, through a buffer that holds a tenth of the data, as with data larger than memory. The sampler
mixes at least 64 blocks in a window, so a small dataset is named as many times over as it takes for a tenth of it to be
enough; its files are read anew each time.

Rivals (`loading_rivals.py`) run with `--workers` processes and make copies of the data in `--scratch`, untimed. All but
the first need Hugging Face `datasets` (in the `dev` extra): without it they are left out.
"""

import contextlib
import itertools
import shutil
import statistics
import tempfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import click
import loading_rivals as rivals
import numpy as np
import torch
from streaming import CPU, larger, memory_row, waiting_rows
from timing import median_ratio, report, take_turns
from torch import Tensor

from graspq.common.options import Command
from graspq.datasets.dataset import open_shards
from graspq.datasets.loader import TransitionLoader
from graspq.datasets.pool import ShardPool
from graspq.train.batch import to_tensors

EPOCHS = 10
PNG = "PNG files, PyTorch DataLoader"
Run = tuple[Callable[[], None], int]


def consume(batches: Iterable[Any], count: int, slack: int = 0) -> None:
    """Take `count` batches; refuse an epoch that lacks more than `slack` of them.

    Raises:
        ClickException: it does.
    """
    taken = sum(1 for _ in itertools.islice(batches, count))
    if taken < count - slack:
        raise click.ClickException(f"a rival's epoch ended after {taken} batches, expected {count}: ask for fewer")


def ours(
    open_pool: Callable[[], ShardPool], batch_size: int, batches: int, buffer_bytes: int | None = None
) -> Callable[[], None]:
    """Return what opens a pool and takes so many batches with s' from it as tensors; no buffer given: all fits."""

    def run() -> None:
        pool = open_pool()
        room = 2 * pool.rows * pool.row_bytes if buffer_bytes is None else buffer_bytes
        with TransitionLoader(pool, batch_size, 0, room) as loader:
            consume((to_tensors(batch, CPU) for batch in loader), batches)

    return run


def known(pictures: rivals.Table) -> dict[tuple[int, bytes], int]:
    """Return which picture follows on each picture and action, by checksum."""
    sums = [zlib.crc32(picture.tobytes()) for picture in pictures.pictures()]
    actions, following = pictures.columns["action"], pictures.next_row
    return {(sums[row], actions[row].tobytes()): sums[following[row]] for row in range(len(sums))}


def check(name: str, epoch: rivals.Epoch, transitions: dict[tuple[int, bytes], int]) -> None:
    """Refuse a rival whose first batch is not of transitions of the data.

    Raises:
        ClickException: it is not.
    """

    def checksum(picture: Tensor) -> int:
        if picture.is_floating_point():
            picture = (picture.permute(1, 2, 0) * 255).round().to(torch.uint8)
        return zlib.crc32(np.ascontiguousarray(picture.numpy()).tobytes())

    batch = next(iter(epoch()))
    for image, following, action in zip(batch["image"], batch["next_image"], batch["action"], strict=True):
        found = transitions.get((checksum(image), action.numpy().astype(np.float32).tobytes()))
        if found != checksum(following):
            raise click.ClickException(f"{name}: gives a transition that is not in the data")


def rival_runs(pool: ShardPool, folder: Path, batch_size: int, batches: int, workers: int) -> dict[str, Run]:
    """Make the rivals and return, for each, what runs and how many samples it takes."""
    data = rivals.Table(pool)
    transitions, size = known(data), (batch_size, workers)
    makers: dict[str, Callable[[], rivals.Epoch]] = {
        PNG: lambda: rivals.png_files(data, folder / "png", *size),
        "Hugging Face datasets, map-style": lambda: rivals.hugging_face_map(pool, folder / "arrow", *size),
        "Hugging Face datasets, streaming": lambda: rivals.hugging_face_stream(pool, *size),
        "LeRobot-style random access": lambda: rivals.lerobot_style(data, folder / "lerobot", *size),
    }
    runs: dict[str, Run] = {}
    for name, make in makers.items():
        try:
            epoch = make()
        except ImportError as error:
            click.echo(f"{name}: left out ({error})", err=True)
            continue
        check(name, epoch, transitions)
        # Each worker's last batch may be too small to count.
        runs[name] = (lambda epoch=epoch: consume(epoch(), batches, workers)), batch_size * batches
    return runs


def our_runs(shards: tuple[str, ...], pool: ShardPool, batch_size: int) -> tuple[dict[str, Run], int]:
    """Return our own ways to read an epoch, and the buffer of the streaming ones, bytes."""
    batches = pool.rows // batch_size
    wide, buffer_bytes = larger(pool, batch_size)
    runs = {
        "graspq, streaming": ours(lambda: wide, batch_size, batches, buffer_bytes),
        "graspq, streaming, SHA-256 of all files first": ours(
            lambda: larger(open_shards(shards), batch_size)[0], batch_size, batches, buffer_bytes
        ),
        "graspq, all in the buffer, first epoch": ours(lambda: pool, batch_size, batches),
    }
    found = {name: (run, batch_size * batches) for name, run in runs.items()}
    many = EPOCHS * batches
    found[f"graspq, all in the buffer, {EPOCHS} epochs"] = ours(lambda: pool, batch_size, many), batch_size * many
    return found, buffer_bytes


def speed_rows(runs: dict[str, Run], turns: int) -> list[dict[str, Any]]:
    """Return samples a second of each, and how many times as fast as PNG files it is."""
    seconds = take_turns({name: run for name, (run, _) in runs.items()}, turns)
    pace = {name: [value / runs[name][1] for value in values] for name, values in seconds.items()}
    return [
        {
            "loader": name,
            "samples a second": 1 / statistics.median(values),
            "times PNG files": median_ratio(pace[PNG], values) if PNG in pace else None,
        }
        for name, values in pace.items()
    ]


@contextlib.contextmanager
def scratch_folder(given: Path | None) -> Iterator[Path]:
    """Give the folder for the rivals' copies: the given one, which is kept, or a temporary one."""
    if given is not None:
        given.mkdir(parents=True, exist_ok=True)
        yield given
        return
    folder = Path(tempfile.mkdtemp(prefix="graspq-loading-"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@click.command(cls=Command)
@click.option("--shards", multiple=True, required=True, help="Dataset folders, shard files or globs.")
@click.option("--batch-size", type=click.IntRange(2), default=256, show_default=True, help="Transitions of a batch.")
@click.option("--workers", type=click.IntRange(0), default=2, show_default=True, help="Worker processes of each rival.")
@click.option("--turns", type=click.IntRange(1), default=5, show_default=True, help="Turns that are measured.")
@click.option("--rival-batches", type=click.IntRange(1), default=None, help="The rivals'; an epoch if not given.")
@click.option("--steps", type=click.IntRange(1), default=20, show_default=True, help="Training steps in a turn.")
@click.option("--memory-steps", type=click.IntRange(8), default=2400, show_default=True, help="Of the memory test.")
@click.option("--threads", type=click.IntRange(1), default=None, help="CPU threads; torch's own choice if not given.")
@click.option(
    "--part",
    "parts",
    multiple=True,
    type=click.Choice(["speed", "waiting", "memory"]),
    default=["speed", "waiting", "memory"],
    show_default=True,
    help="What to measure; may be given several times.",
)
@click.option("--scratch", type=click.Path(path_type=Path), default=None, help="Folder to keep the rivals' copies in.")
@click.option("--out", type=click.Path(path_type=Path), default=None, help="JSON file for the figures.")
def main(
    shards: tuple[str, ...],
    batch_size: int,
    workers: int,
    turns: int,
    rival_batches: int | None,
    steps: int,
    memory_steps: int,
    threads: int | None,
    parts: tuple[str, ...],
    scratch: Path | None,
    out: Path | None,
) -> None:
    """Measure reading of shuffled transitions, waiting for data in training, and memory of a streaming loader."""
    pool = open_shards(shards)
    facts: dict[str, Any] = {"batch size": batch_size, "workers of each rival": workers, "turns": turns}
    found: dict[str, list[dict[str, Any]]] = {}
    if "speed" in parts:
        with scratch_folder(scratch) as folder:
            runs, facts["streaming buffer, bytes"] = our_runs(shards, pool, batch_size)
            runs |= rival_runs(pool, folder, batch_size, rival_batches or pool.rows // batch_size, workers)
            found["Loading shuffled transitions with s' from disk"] = speed_rows(runs, turns)
    if "waiting" in parts:
        found["waiting for data in training"] = list(waiting_rows(shards, pool, steps, turns, threads))
    if "memory" in parts:
        found["resident memory of streaming"] = [memory_row(shards, memory_steps, threads)]
    title = next(iter(found))
    report(title, found.pop(title), facts | found, out)


if __name__ == "__main__":
    main()
