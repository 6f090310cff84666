"""Episodes to Arrow tables and back to numpy, and the Parquet settings: a row per step, a row per episode.

The image column is raw RGB: with zstd that is smaller than PNG and decodes ten times as fast (DESIGN, section 3).
"""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from graspq.datasets import columns
from graspq.datasets.columns import Column, sizes_of
from graspq.datasets.episode import Episode
from graspq.datasets.manifest import Manifest

COMPRESSION_LEVEL = 6


def steps_schema(manifest: Manifest) -> pa.Schema:
    """Return the schema of the steps table: one row per step, one row group per block.

    The metadata of the schema and of the fields say what the numbers mean; they depend on `manifest` alone.
    """
    return _schema(manifest, "steps", columns.STEPS)


def episodes_schema(manifest: Manifest) -> pa.Schema:
    """Return the schema of the episodes table: one row per episode."""
    return _schema(manifest, "episodes", columns.EPISODES)


def parquet_settings(schema: pa.Schema) -> dict[str, Any]:
    """Return the writer's settings: zstd, page checksums, no dictionaries, no statistics on images."""
    return {
        "compression": "zstd",
        "compression_level": COMPRESSION_LEVEL,
        "use_dictionary": False,
        "write_statistics": [name for name in schema.names if pa.types.is_integer(schema.field(name).type)],
        "write_page_checksum": True,
        "version": "2.6",
        "data_page_version": "1.0",
    }


def steps_table(manifest: Manifest, episodes: Sequence[Episode]) -> pa.Table:
    """Return the steps of `episodes`, in their order, with labels; columns as in `steps_schema`."""
    schema = steps_schema(manifest)
    values = [columns.step_values(episode, columns.episode_row(episode), manifest) for episode in episodes]
    arrays = [
        _array(np.concatenate([value[name] for value in values]), schema.field(name).type) for name in schema.names
    ]
    return pa.Table.from_arrays(arrays, schema=schema)


def episodes_table(manifest: Manifest, episodes: Sequence[Episode]) -> pa.Table:
    """Return one row per episode; columns as in `episodes_schema`."""
    return pa.Table.from_pylist(
        [columns.episode_row(episode) for episode in episodes], schema=episodes_schema(manifest)
    )


def _schema(manifest: Manifest, table: str, described: Sequence[Column]) -> pa.Schema:
    sizes = sizes_of(manifest.image_shape, manifest.action)
    fields = [
        pa.field(
            column.name,
            column.arrow_type(sizes),
            nullable=column.nullable,
            metadata={key: json.dumps(value) for key, value in column.metadata(manifest).items()} or None,
        )
        for column in described
    ]
    facts = {
        "image_shape": list(manifest.image_shape),
        "action_limits": list(manifest.action.limits),
        "discount": manifest.discount,
        **columns.phi_range(manifest),
    }
    metadata = {
        "graspq.table": table,
        "graspq.format_version": str(manifest.format_version),
        "graspq.task": manifest.task_name,
        **{f"graspq.{name}": json.dumps(value) for name, value in facts.items()},
    }
    return pa.schema(fields, metadata=metadata)


def to_numpy(column: pa.ChunkedArray) -> Any:
    """Return a column as numpy: [N], or [N, ...] for arrays and images; a view wherever Arrow allows one."""
    return _numpy(column.chunk(0) if column.num_chunks == 1 else pa.concat_arrays(column.chunks))


def _numpy(array: pa.Array) -> Any:
    if pa.types.is_fixed_size_binary(array.type):
        width = array.type.byte_width
        flat = np.frombuffer(array.buffers()[1], np.uint8, len(array) * width, array.offset * width)
        flat.flags.writeable = False
        return flat.reshape(len(array), width)
    if pa.types.is_fixed_size_list(array.type):
        inner = _numpy(array.flatten())
        return inner.reshape(len(array), array.type.list_size, *inner.shape[1:])
    return array.to_numpy(zero_copy_only=False)


def _array(values: Any, kind: pa.DataType) -> pa.Array:
    """Return rows as an Arrow array; images are taken as they lie in memory."""
    if pa.types.is_fixed_size_binary(kind):
        return pa.Array.from_buffers(kind, len(values), [None, pa.py_buffer(values)])
    if pa.types.is_fixed_size_list(kind):
        inner = np.ascontiguousarray(values).reshape(-1, *values.shape[2:])
        return pa.FixedSizeListArray.from_arrays(_array(inner, kind.value_type), type=kind)
    return pa.array(values, kind)
