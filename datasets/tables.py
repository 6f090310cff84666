"""Episodes to Arrow tables: the steps of a block with their labels, and one row per episode.

The way back is `dataset`. Dimension key: N rows, T steps of an episode, A = 4 action.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from graspq.datasets.episode import Episode
from graspq.datasets.labels import mc_return, synthetic_action
from graspq.datasets.manifest import Manifest
from graspq.datasets.schema import episodes_schema, steps_schema


def steps_table(manifest: Manifest, episodes: Sequence[Episode]) -> pa.Table:
    """Return the steps of `episodes`, in their order, with labels; columns as in `schema.steps_schema`."""
    schema = steps_schema(manifest)
    limits, discount = manifest.action_limits, manifest.discount
    columns: dict[str, Any] = {
        "episode_id": np.repeat([e.episode_id for e in episodes], [e.steps for e in episodes]),
        "step": np.concatenate([np.arange(e.steps) for e in episodes]),
        "action": np.concatenate([e.actions for e in episodes]),
        "reward": np.concatenate([e.rewards for e in episodes]),
        "terminal": np.concatenate([np.arange(e.steps) == e.steps - 1 for e in episodes]),
        "gripper_pose": np.concatenate([e.gripper_poses for e in episodes]),
        "mc_return": np.concatenate([mc_return(e.rewards, discount) for e in episodes]),
        "synthetic_action": np.concatenate([synthetic_action(e.gripper_poses, e.final_pose, limits) for e in episodes]),
    }
    arrays = {name: _array(values, schema.field(name).type) for name, values in columns.items()}
    images = np.concatenate([e.images for e in episodes])
    image_type = schema.field("image").type
    arrays["image"] = pa.Array.from_buffers(image_type, len(images), [None, pa.py_buffer(images)])
    return pa.Table.from_arrays([arrays[name] for name in schema.names], schema=schema)


def episodes_table(manifest: Manifest, episodes: Sequence[Episode]) -> pa.Table:
    """Return one row per episode; columns as in `schema.episodes_schema`."""
    schema = episodes_schema(manifest)
    rows = [
        {
            **{name: getattr(e, name) for name in schema.names if name not in ("object_poses", "final_pose")},
            "object_poses": e.object_poses.tolist(),
            "final_pose": e.final_pose.tolist(),
            "object_ids": list(e.object_ids),
        }
        for e in episodes
    ]
    return pa.Table.from_pylist(rows, schema=schema)


def _array(values: Any, kind: pa.DataType) -> pa.Array:
    if not pa.types.is_fixed_size_list(kind):
        return pa.array(values, kind)
    flat = pa.array(np.ascontiguousarray(values).reshape(-1), kind.value_type)
    return pa.FixedSizeListArray.from_arrays(flat, type=kind)
