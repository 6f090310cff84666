"""Reads one block, a row group of a steps table, into numpy without copying its images.

Page checksums are verified on every read. Dimension key: N rows of the block, H W C image.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from graspq.common.errors import UserError
from graspq.datasets.batch import Bool, Int64, Records
from graspq.datasets.columns import RecordType
from graspq.datasets.episode import UInt8
from graspq.datasets.labels import mc_return

REMEDY = "`grasp-data verify` lists all faults; the command that made the dataset makes bad shards again"


@dataclass(frozen=True)
class BlockRef:
    """Where a block is.

    Attributes:
        path: the shard's steps table.
        row_group: its index there.
        block: its number in its dataset.
        rows: its number of steps.
        episodes: its number of episodes.
        key: what identifies the block wherever the dataset lies, such as `"regular/0/17"` (task, seed, block).
    """

    path: Path
    row_group: int
    block: int
    rows: int
    episodes: int
    key: str


@dataclass(frozen=True, eq=False)
class BlockArrays:
    """The rows of one block; whole episodes, in order. Read-only views of the Parquet reader's memory.

    Attributes:
        block: number of the block.
        images: uint8 [N, H, W, C], RGB.
        records: [N] of `columns.record_dtype`, all other columns.
        first_rows: int64 [E], the first row of each of its E episodes.
        lengths: int64 [E], steps of each.
    """

    block: int
    images: UInt8
    records: Records
    first_rows: Int64
    lengths: Int64

    @functools.cached_property
    def opaque(self) -> Records:
        """The records as plain bytes [N]: numpy copies one in a tenth of the time that it takes field by field."""
        return opaque(self.records)

    @functools.cached_property
    def next_rows(self) -> list[int]:
        """The row of each row's s′; its own where it is terminal."""
        following: list[int] = (np.arange(len(self.records)) + ~self.records["terminal"]).tolist()
        return following

    @property
    def bytes(self) -> int:
        """Memory that it holds."""
        return self.images.nbytes + self.records.nbytes


def opaque(records: Records) -> Records:
    """Return a view of records as plain bytes, each a `void` of their size."""
    return records.view(np.dtype((np.void, records.dtype.itemsize)))


def read_block(
    ref: BlockRef, image_shape: tuple[int, int, int], dtype: RecordType, metadata: Any = None
) -> BlockArrays:
    """Return the rows of a block.

    Args:
        ref: the block.
        image_shape: (H, W, C).
        dtype: of the records, see `columns.record_dtype`.
        metadata: the file's footer where it was read before.

    Raises:
        UserError: the file is missing, truncated or damaged; the message names the file and the block.
    """
    try:
        with pq.ParquetFile(ref.path, metadata=metadata, page_checksum_verification=True, memory_map=False) as file:
            table = file.read_row_group(ref.row_group, use_threads=False)
        return _block_arrays(ref, table, image_shape, dtype)
    except (OSError, pa.ArrowException, KeyError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise UserError(f"{ref.path}: block {ref.block} cannot be read ({reason}); {REMEDY}") from None


def read_columns(ref: BlockRef, names: Sequence[str], metadata: Any = None) -> dict[str, Any]:
    """Return some columns of a block as numpy arrays, [N] or [N, ...], without reading the others.

    Args:
        ref: the block.
        names: of columns of the steps table.
        metadata: the file's footer where it was read before.

    Raises:
        UserError: the file is missing, truncated or damaged; the message names the file and the block.
    """
    try:
        with pq.ParquetFile(ref.path, metadata=metadata, page_checksum_verification=True, memory_map=False) as file:
            table = file.read_row_group(ref.row_group, columns=list(names), use_threads=False)
        return {name: _numpy(table.column(name)) for name in names}
    except (OSError, pa.ArrowException, KeyError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise UserError(f"{ref.path}: block {ref.block} cannot be read ({reason}); {REMEDY}") from None


def read_episode_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of an episodes table; columns as in `columns.EPISODES`.

    Raises:
        UserError: the file is missing or damaged.
    """
    try:
        table = pq.read_table(path, page_checksum_verification=True, use_threads=False, partitioning=None)
        rows: list[dict[str, Any]] = table.to_pylist()
    except (OSError, pa.ArrowException, ValueError) as error:
        raise UserError(f"{path}: cannot be read ({' '.join(str(error).split())}); {REMEDY}") from None
    return rows


def relabelled(block: BlockArrays, discount: float) -> BlockArrays:
    """Return the block with `mc_return` made anew from its rewards, with another discount γ in [0, 1]."""
    records = block.records.copy()
    for first, length in zip(block.first_rows.tolist(), block.lengths.tolist(), strict=True):
        episode = slice(first, first + length)
        records["mc_return"][episode] = mc_return(records["reward"][episode], discount)
    return replace(block, records=records)


def _block_arrays(ref: BlockRef, table: pa.Table, image_shape: tuple[int, int, int], dtype: RecordType) -> BlockArrays:
    records = np.zeros(table.num_rows, dtype)
    for name in (dtype.names or ())[:-1]:
        records[name] = _numpy(table.column(name))
    records["block"] = ref.block
    terminal: Bool = records["terminal"]
    first_rows = np.flatnonzero(np.concatenate([[True], terminal[:-1]])).astype(np.int64)
    if table.num_rows != ref.rows or len(first_rows) != ref.episodes or not terminal[-1]:
        raise ValueError(f"expected {ref.rows} rows of {ref.episodes} whole episodes")
    return BlockArrays(
        block=ref.block,
        images=_numpy(table.column("image")).reshape(-1, *image_shape),
        records=records,
        first_rows=first_rows,
        lengths=np.diff(np.append(first_rows, table.num_rows)),
    )


def _numpy(column: pa.ChunkedArray) -> Any:
    """Return a column as numpy: [N], or [N, ...] for arrays and images; a view wherever Arrow allows one."""
    return _array(column.chunk(0) if column.num_chunks == 1 else pa.concat_arrays(column.chunks))


def _array(array: pa.Array) -> Any:
    if pa.types.is_fixed_size_binary(array.type):
        width = array.type.byte_width
        flat = np.frombuffer(array.buffers()[1], np.uint8, len(array) * width, array.offset * width)
        flat.flags.writeable = False
        return flat.reshape(len(array), width)
    if pa.types.is_fixed_size_list(array.type):
        inner = _array(array.flatten())
        return inner.reshape(len(array), array.type.list_size, *inner.shape[1:])
    return array.to_numpy(zero_copy_only=False)
