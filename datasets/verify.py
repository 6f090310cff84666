"""Verifies a dataset: every byte against the manifest, every label against the rewards and poses it comes from.

A single flipped bit in any file of the dataset is found, whichever file it is in.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from graspq.common.errors import CommandError
from graspq.common.files import LOCK_NAME, read_json, sha256_of
from graspq.datasets.blocks import BlockRef, read_block
from graspq.datasets.columns import record_dtype, wrong_labels
from graspq.datasets.dataset import Shard, has_changed
from graspq.datasets.images import decoded
from graspq.datasets.manifest import MANIFEST_NAME, Manifest, ShardEntry
from graspq.datasets.tables import episodes_schema, steps_schema
from graspq.engine import EngineSettings, Place, run

OBJECT_SET = "objects/object_set.json"
CHECKSUM = f"{OBJECT_SET}.sha256"
Progress = Callable[[int], Any]


@dataclass(frozen=True)
class Report:
    """What `verify` found.

    Attributes:
        faults: one line each; none means that the dataset is what its manifest says.
        notes: one line each, of what is no fault: files that do not belong to it, blocks not collected yet.
        files: number of files that were checked.
        bytes: their bytes.
    """

    faults: tuple[str, ...]
    notes: tuple[str, ...]
    files: int
    bytes: int


@dataclass(frozen=True)
class Checking:
    """How shards are checked; the `Work` of a verification."""

    folder: Path

    def folders(self) -> Sequence[Path]:
        """Return nothing: shards are read where they lie."""
        return ()

    @contextlib.contextmanager
    def open(self, place: Place) -> Iterator[Callable[[ShardEntry], list[str]]]:
        """Open the dataset."""
        manifest = Manifest.load(self.folder)
        yield lambda entry: list(_faults(Shard(self.folder, manifest, entry)))


def verify(folder: Path | str, progress: Progress = lambda _: None, workers: int | None = 0) -> Report:
    """Check a whole dataset; one that is extended meanwhile is checked again if a fault was found.

    Args:
        folder: the dataset.
        progress: called with the bytes of each shard that has been checked; `Manifest.bytes` in all.
        workers: processes of this machine; 0 for this process itself, None for all cores.

    Raises:
        UserError: the folder is no dataset, or its manifest is damaged.
    """
    folder = Path(folder)
    while True:
        manifest = Manifest.load(folder)
        report = _verified(folder, manifest, progress, workers)
        if not report.faults or not has_changed(folder, manifest):
            return report


def _verified(folder: Path, manifest: Manifest, progress: Progress, workers: int | None) -> Report:
    faults = [*_named_files(folder, manifest), *_object_files(folder, manifest)]
    engine = EngineSettings(workers=workers if len(manifest.shards) > 1 else 0)
    by_shard: dict[str, list[str]] = {}
    with contextlib.closing(run(Checking(folder), manifest.shards, engine, name=lambda entry: entry.name)) as checked:
        for entry, found in checked:
            by_shard[entry.name] = found
            progress(entry.bytes)
    faults += [fault for entry in manifest.shards for fault in by_shard[entry.name]]
    following = 0
    belonging = _belonging(folder, manifest)
    present = [path for path in belonging if (folder / path).is_file()]
    notes = [f"{folder / path}: not part of the dataset, no manifest lists it" for path in _others(folder, belonging)]
    for entry in manifest.shards:
        if entry.first_block != following:
            notes.append(f"{folder}: blocks {following} to {entry.first_block - 1} are not there (yet)")
        following = entry.first_block + entry.blocks
    return Report(tuple(faults), tuple(notes), len(present), sum((folder / path).stat().st_size for path in present))


def _named_files(folder: Path, manifest: Manifest) -> Iterator[str]:
    for path, digest in manifest.files.items():
        yield from _checked(folder / path, digest)


def _object_files(folder: Path, manifest: Manifest) -> Iterator[str]:
    faults = list(_checked(folder / OBJECT_SET, str(manifest.object_set.get("sha256"))))
    yield from faults
    if not faults:
        for path, digest in _object_digests(folder).items():
            yield from _checked(folder / path, digest)


def _object_digests(folder: Path) -> dict[str, str]:
    """Return path within the dataset → SHA-256 of all files that the object set lists."""
    try:
        listed = read_json(folder / OBJECT_SET, "object set")["objects"]
        records = listed.values() if isinstance(listed, dict) else listed
        return {f"objects/{name}": digest for record in records for name, digest in record["sha256"].items()}
    except (CommandError, AttributeError, KeyError, TypeError):
        return {}


def _checked(path: Path, digest: str) -> Iterator[str]:
    try:
        if sha256_of(path) != digest:
            yield f"{path}: damaged, its SHA-256 is not the one listed"
    except OSError as error:
        yield f"{path}: listed but cannot be read ({error.strerror})"


def _belonging(folder: Path, manifest: Manifest) -> set[str]:
    shards = {path for entry in manifest.shards for path in entry.files}
    return {MANIFEST_NAME, OBJECT_SET, CHECKSUM, *manifest.files, *shards, *_object_digests(folder)}


def _others(folder: Path, belonging: set[str]) -> list[str]:
    files = (path for path in folder.rglob("*") if path.is_file() and path != folder / LOCK_NAME)
    return sorted(name for path in files if (name := path.relative_to(folder).as_posix()) not in belonging)


def _faults(shard: Shard) -> Iterator[str]:
    """Yield the faults of one shard; its content is compared only where its bytes are right."""
    intact = True
    for path in (shard.steps, shard.episodes):
        try:
            shard.check(path)
        except CommandError as error:
            intact = False
            yield error.message.rsplit("; ", 1)[0] + (_where(shard) if path == shard.steps else "")
    if intact:
        try:
            yield from _content(shard)
        except (CommandError, OSError, pa.ArrowException, LookupError, ValueError, TypeError) as error:
            yield f"{shard.steps}: not the tables expected ({error})"


def _where(shard: Shard) -> str:
    """Say which blocks of a damaged steps table fail their page checksums."""
    failed = []
    if not shard.steps.is_file():
        return ""
    try:
        with pq.ParquetFile(shard.steps, page_checksum_verification=True) as file:
            blocks = shard.entry.block_range[: file.num_row_groups]
            for index, block in enumerate(blocks):
                try:
                    file.read_row_group(index, use_threads=False)
                except (OSError, pa.ArrowException):
                    failed.append(str(block))
    except (OSError, pa.ArrowException):
        return ""
    return f" (block {', '.join(failed)})" if failed else ""


def _content(shard: Shard) -> Iterator[str]:
    manifest, entry = shard.manifest, shard.entry
    for path, expected in ((shard.steps, steps_schema(manifest)), (shard.episodes, episodes_schema(manifest))):
        if not pq.read_schema(path).equals(expected, check_metadata=True):
            yield f"{path}: its columns or their metadata are not those of the manifest"
            return
    rows = shard.episode_rows(verify=False)
    blocks = [row["block"] for row in rows]
    counts = (len(rows), sum(row["steps"] for row in rows), sum(row["success"] for row in rows))
    if counts != (entry.episodes, entry.rows, entry.successes) or sorted(set(blocks)) != list(entry.block_range):
        yield f"{shard.episodes}: its episodes, steps, successes or blocks are not those of the manifest"
        return
    if (rows[0]["seed"], rows[-1]["seed"]) != tuple(entry.seeds):
        yield f"{shard.episodes}: its seeds are not those of the manifest"
    ids = [row["episode_id"] for row in rows]
    if ids != list(range(ids[0], ids[0] + len(ids))) or blocks != sorted(blocks):
        yield f"{shard.episodes}: its episodes are out of order"
    for ref in shard.blocks(shard.footer()):
        episodes = [row for row in rows if row["block"] == ref.block]
        yield from (f"{shard.steps}: block {ref.block}: {fault}" for fault in _block(manifest, ref, episodes))


def _block(manifest: Manifest, ref: BlockRef, episodes: list[dict[str, Any]]) -> Iterator[str]:
    arrays = read_block(ref, manifest.image_shape, record_dtype(manifest.image_shape, manifest.action))
    if arrays.lengths.tolist() != [row["steps"] for row in episodes]:
        yield "the lengths of its episodes are not those of the episodes table"
        return
    for row in episodes:
        if "final_image" in row:
            decoded(row["final_image"], manifest.image_shape)
    for row, first, length in zip(episodes, arrays.first_rows.tolist(), arrays.lengths.tolist(), strict=True):
        records = arrays.records[first : first + length]
        steps = {name: records[name] for name in records.dtype.names or ()}
        for name in wrong_labels(steps, row, manifest):
            yield f"episode {row['episode_id']}: {name} is not what its other columns give"
