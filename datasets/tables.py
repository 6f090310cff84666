"""Episodes to Arrow tables and back to numpy, and the Parquet settings: a row per step, a row per episode."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from graspq.datasets import columns, images
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
    values = [columns.step_values(episode, manifest) for episode in episodes]
    arrays = [
        _array(np.concatenate([value[name] for value in values]), schema.field(name).type) for name in schema.names
    ]
    return pa.Table.from_arrays(arrays, schema=schema)


def episodes_table(manifest: Manifest, episodes: Sequence[Episode]) -> pa.Table:
    """Return one row per episode; columns as in `episodes_schema`."""
    rows = [columns.episode_row(episode, manifest.format_version) for episode in episodes]
    return pa.Table.from_pylist(rows, schema=episodes_schema(manifest))


def _schema(manifest: Manifest, table: str, described: Sequence[Column]) -> pa.Schema:
    sizes = sizes_of(manifest.image_shape, manifest.action)
    fields = [
        pa.field(
            column.stored_name(manifest.format_version),
            column.arrow_type(sizes, manifest.format_version),
            nullable=column.nullable,
            metadata={key: json.dumps(value) for key, value in column.metadata(manifest).items()} or None,
        )
        for column in described
        if column.since <= manifest.format_version
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
    """Return a column of numbers as numpy, [N] or [N, ...]; a view wherever Arrow allows one."""
    return _numpy(images.only(column))


def _numpy(array: pa.Array) -> Any:
    if pa.types.is_fixed_size_list(array.type):
        inner = _numpy(array.flatten())
        return inner.reshape(len(array), array.type.list_size, *inner.shape[1:])
    return array.to_numpy(zero_copy_only=False)


def _array(values: Any, kind: pa.DataType) -> pa.Array:
    if pa.types.is_binary(kind) or pa.types.is_fixed_size_binary(kind):
        return images.to_arrow(values, kind)
    if pa.types.is_fixed_size_list(kind):
        inner = np.ascontiguousarray(values).reshape(-1, *values.shape[2:])
        return pa.FixedSizeListArray.from_arrays(_array(inner, kind.value_type), type=kind)
    return pa.array(values, kind)
