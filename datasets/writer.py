"""Writes a shard once: temporary file, fsync, read back and verified, rename, and only then its line in the manifest.

The bytes depend on the episodes and the manifest's description alone. A writer that is killed leaves `.tmp-*` files,
which `remove_leftovers` clears, a finished file that the manifest does not list, which is written again, or the file
of a shard that a longer one has replaced, which is cleared too.
"""

import errno
import hashlib
import itertools
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from graspq.common.errors import CommandError, MachineError, told
from graspq.common.files import committed, remove_temporaries, sha256_of
from graspq.datasets.episode import Episode
from graspq.datasets.manifest import (
    MANIFEST_NAME,
    SHARD_NAME,
    Manifest,
    ShardEntry,
    episodes_file,
    shard_name,
    steps_file,
)
from graspq.datasets.tables import episodes_table, parquet_settings, steps_table


def write_shard(
    folder: Path, manifest: Manifest, first_block: int, blocks: int, episodes: Sequence[Episode]
) -> ShardEntry:
    """Write the two files of a shard durably; `commit_shard` then makes it part of the dataset.

    Args:
        folder: the dataset.
        manifest: its description; which shards it lists does not matter.
        first_block: number of the first block.
        blocks: number of blocks.
        episodes: the episodes of these blocks in order; only the last block may be short.

    Returns:
        The entry for the manifest.

    Raises:
        ValueError: the episodes are not those of these blocks.
        UserError: the disk is full, or the folder cannot be written to.
    """
    by_block = _grouped(manifest, first_block, blocks, episodes)
    name = shard_name(first_block, blocks, len(episodes), manifest.block_size)
    tables = {
        steps_file(name): [steps_table(manifest, group) for group in by_block],
        episodes_file(name): [episodes_table(manifest, episodes)],
    }
    encoded = {path: _encode(groups) for path, groups in tables.items()}
    total = sum(len(content) for content in encoded.values())
    for path, groups in tables.items():
        _write(folder / path, encoded[path], groups, total)
    return ShardEntry(
        name=name,
        first_block=first_block,
        blocks=blocks,
        episodes=len(episodes),
        rows=sum(episode.steps for episode in episodes),
        successes=sum(bool(episode.success) for episode in episodes),
        seeds=(int(episodes[0].seed), int(episodes[-1].seed)),
        files={path: hashlib.sha256(content).hexdigest() for path, content in encoded.items()},
        sizes={path: len(content) for path, content in encoded.items()},
    )


def commit_shard(folder: Path, manifest: Manifest, entry: ShardEntry) -> Manifest:
    """List a written shard in the manifest, save it, then remove the files that the shard has replaced.

    Returns:
        The manifest as saved. Where a shard of the same first block was listed, `entry` has taken its place.
    """
    updated = manifest.with_shard(entry)
    updated.save(folder)
    _remove_replaced(folder, [entry])
    return updated


def remove_leftovers(folder: Path) -> None:
    """Remove what killed writers left in a dataset: temporary files, and shards that others have replaced."""
    for part in ("", "shards", "episodes", "objects", "objects/meshes"):
        remove_temporaries(folder / part)
    if (folder / MANIFEST_NAME).is_file():
        _remove_replaced(folder, Manifest.load(folder).shards)


def _remove_replaced(folder: Path, entries: Sequence[ShardEntry]) -> None:
    """Remove the shards that begin with the block of a listed one and are not that one."""
    listed = {entry.first_block: entry.files for entry in entries}
    for part in ("shards", "episodes"):
        for path in (folder / part).glob("blocks-*.parquet"):
            if SHARD_NAME.fullmatch(path.stem) is not None:
                files = listed.get(int(path.stem.split("-")[1]))
                if files is not None and f"{part}/{path.name}" not in files:
                    path.unlink(missing_ok=True)


def _grouped(manifest: Manifest, first_block: int, blocks: int, episodes: Sequence[Episode]) -> list[list[Episode]]:
    groups = [list(group) for _, group in itertools.groupby(episodes, key=lambda episode: episode.block)]
    numbers = [group[0].block for group in groups]
    if numbers != list(range(first_block, first_block + blocks)):
        raise ValueError(f"expected the blocks {first_block} .. {first_block + blocks - 1} in order, got {numbers}")
    whole = all(len(group) == manifest.block_size for group in groups[:-1])
    if not whole or not 1 <= len(groups[-1]) <= manifest.block_size:
        raise ValueError(f"expected {manifest.block_size} episodes in each block but the last")
    ids = [episode.episode_id for episode in episodes]
    if ids != list(range(ids[0], ids[0] + len(ids))):
        raise ValueError("episode_id: expected consecutive numbers")
    if manifest.format_version > 1 and any(episode.final_image is None for episode in episodes):
        raise ValueError("final_image: expected one in every episode")
    wrong = next((episode for episode in episodes if episode.images.shape[1:] != manifest.image_shape), None)
    if wrong is not None:
        raise ValueError(f"images: expected {manifest.image_shape}, got {wrong.images.shape[1:]}")
    size = manifest.action.size
    if any(episode.actions.shape[1] != size for episode in episodes):
        raise ValueError(f"actions: expected {size} parts, {', '.join(manifest.action.names)}")
    return groups


def _encode(groups: list[pa.Table]) -> pa.Buffer:
    """Return a Parquet file with one row group per table; in memory, so that its exact size is known first."""
    schema = groups[0].schema
    sink = pa.BufferOutputStream()
    with pq.ParquetWriter(sink, schema, **parquet_settings(schema)) as writer:
        for table in groups:
            writer.write_table(table, row_group_size=table.num_rows)
    return sink.getvalue()


def _write(path: Path, content: pa.Buffer, groups: list[pa.Table], total: int) -> None:
    expected = hashlib.sha256(content).hexdigest()

    def verify(temporary: Path) -> None:
        if sha256_of(temporary) != expected:
            raise OSError(errno.EIO, "what was read back is not what was written", str(path))
        with pq.ParquetFile(temporary, page_checksum_verification=True) as file:
            for index, table in enumerate(groups):
                if not file.read_row_group(index, use_threads=False).equals(table):
                    raise OSError(errno.EIO, "the rows read back are not those written", str(path))

    try:
        with committed(path, verify) as temporary:
            temporary.write_bytes(content)
    except OSError as error:
        raise _explained(error, path, total) from error


def _explained(error: OSError, path: Path, total: int) -> CommandError:
    folder = path.parent.parent
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return MachineError(
            f"{folder}: the disk is full; this shard needs {total:,} bytes; free some space and run the same command "
            "again, finished shards are kept"
        )
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        message = f"{folder}: cannot write here ({error.strerror}); choose another folder or change its rights"
        return MachineError(message)
    return told(
        error, f"{path}: cannot be written ({error.strerror}); finished shards are kept, run the same command again"
    )
