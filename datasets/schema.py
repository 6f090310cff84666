"""Arrow schemas of the two tables of a dataset, and their Parquet settings.

The image column is raw RGB: with zstd that is smaller than PNG and decodes ten times as fast (DESIGN, section 3).
"""

import json
from typing import Any

import pyarrow as pa

from graspq.datasets.manifest import Manifest

OBJECT_POSE = 7
COMPRESSION_LEVEL = 6


def steps_schema(manifest: Manifest) -> pa.Schema:
    """Return the schema of the steps table: one row per step, one row group per block.

    The metadata of the schema and of the fields say what the numbers mean; they depend on `manifest` alone.
    """
    height, width, channels = manifest.image_shape
    image = {"shape": [height, width, channels], "dtype": "uint8", "layout": "H W C", "color": "RGB"}
    action, size = manifest.action, manifest.action.size
    unit = {"order": list(action.names), "unit": "action_limits", "action_limits": list(action.limits)}
    pose = {"order": list(action.pose), "unit": list(action.units), **_phi_range(manifest)}
    fields = [
        _field("episode_id", pa.int64()),
        _field("step", pa.int32()),
        _field("image", pa.binary(height * width * channels), image),
        _field("action", _vector(size), unit),
        _field("reward", pa.float32()),
        _field("terminal", pa.bool_()),
        _field("gripper_pose", _vector(size), pose),
        _field("mc_return", pa.float32(), {"discount": manifest.discount}),
        _field("synthetic_action", _vector(size), unit),
    ]
    return pa.schema(fields, metadata=_table_metadata(manifest, "steps"))


def episodes_schema(manifest: Manifest) -> pa.Schema:
    """Return the schema of the episodes table: one row per episode."""
    poses = {"order": ["x", "y", "z", "qx", "qy", "qz", "qw"], "unit": "m, unit quaternion"}
    final = {"order": list(manifest.action.pose), "unit": list(manifest.action.units)}
    fields = [
        _field("episode_id", pa.int64()),
        _field("block", pa.int64()),
        _field("seed", pa.int64()),
        _field("object_ids", pa.list_(pa.field("element", pa.string(), nullable=False))),
        _field("object_poses", pa.list_(pa.field("element", _vector(OBJECT_POSE), nullable=False)), poses),
        _field("steps", pa.int32()),
        _field("end", pa.string()),
        _field("success", pa.bool_()),
        pa.field("lifted_object", pa.string()),
        _field("policy", pa.string()),
        _field("exploration", pa.float64()),
        _field("final_pose", _vector(manifest.action.size), final),
    ]
    return pa.schema(fields, metadata=_table_metadata(manifest, "episodes"))


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


def _field(name: str, kind: pa.DataType, metadata: dict[str, Any] | None = None) -> pa.Field:
    described = {key: json.dumps(value) for key, value in (metadata or {}).items()}
    return pa.field(name, kind, nullable=False, metadata=described or None)


def _vector(length: int) -> pa.DataType:
    return pa.list_(pa.field("element", pa.float32(), nullable=False), length)


def _table_metadata(manifest: Manifest, table: str) -> dict[str, str]:
    return {
        "graspq.table": table,
        "graspq.format_version": str(manifest.format_version),
        "graspq.task": manifest.task_name,
        "graspq.image_shape": json.dumps(list(manifest.image_shape)),
        "graspq.action_limits": json.dumps(list(manifest.action_limits)),
        "graspq.discount": json.dumps(manifest.discount),
        **{f"graspq.{name}": json.dumps(value) for name, value in _phi_range(manifest).items()},
    }


def _phi_range(manifest: Manifest) -> dict[str, list[float]]:
    return {} if manifest.phi_range is None else {"phi_range": list(manifest.phi_range)}
