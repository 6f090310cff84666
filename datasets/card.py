"""The dataset card, `README.md`: read by people, and by Hugging Face `datasets`, which finds both tables by its header.

Its text depends on the manifest alone. The manifest lists its digest, so that `verify` covers it.
"""

import dataclasses
import hashlib
from pathlib import Path

from graspq.common.files import write_text
from graspq.datasets.manifest import Manifest, steps_file

CARD_NAME = "README.md"
SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
LARGER_SIZES = ((10_000_000, "1M<n<10M"), (100_000_000, "10M<n<100M"))

# Older versions of Hugging Face `datasets` cannot infer a fixed-size binary column: the types are declared therefore.
TEMPLATE = """\
---
pretty_name: graspq {task}, {episodes:,} grasps
license: mit
task_categories:
- robotics
- reinforcement-learning
tags:
- grasping
- off-policy
- offline-reinforcement-learning
- simulation
- graspq
size_categories:
- {size}
configs:
- config_name: steps
  default: true
  data_files:
  - split: train
    path: shards/*.parquet
- config_name: episodes
  data_files:
  - split: train
    path: episodes/*.parquet
dataset_info:
- config_name: steps
  features:
{steps_features}
- config_name: episodes
  features:
{episodes_features}
---

# graspq {task}: {episodes:,} grasps

{episodes:,} simulated grasp attempts of the **{task}** task ({success:.1%} successful), {rows:,} steps; \
collected by graspq after [Quillen et al. 2018](https://arxiv.org/abs/1802.10264).
One row of `shards/*.parquet` is one step, one row of `episodes/*.parquet` is one grasp attempt; `objects/` holds the
meshes ({objects}).

## Reading it

Five lines of Python give the images of a shard as numpy, `uint8 [N, {height}, {width}, 3]`, without a copy:

```python
import numpy as np
import pyarrow.parquet as pq
table = pq.read_table("{first_shard}", page_checksum_verification=True)
column = table["image"].combine_chunks()
images = np.frombuffer(column.buffers()[1], np.uint8).reshape(-1, {height}, {width}, 3)
```

or row by row with Hugging Face `datasets`:

```python
from datasets import load_dataset
steps = load_dataset("path/of/this/folder", "steps", split="train")
image = np.frombuffer(steps[0]["image"], np.uint8).reshape({height}, {width}, 3)
```

## Steps

| column | type | meaning |
|---|---|---|
| `episode_id` | int64 | number of the attempt |
| `step` | int32 | number of the step in its attempt, from 0 |
| `image` | {image_bytes} bytes | RGB before the action, {height} x {width} x 3 uint8, row by row |
| `action` | float32[4] | dx, dy, dz, dphi in units of the action limits, in [-1, 1] |
| `reward` | float32 | 1 for a successful grasp, at the last step only |
| `terminal` | bool | whether this is the last step; the next image of every other row is that of the next row |
| `gripper_pose` | float32[4] | x, y, z (m), phi (rad, unwrapped) before the action |
| `mc_return` | float32 | discounted return from this step on, discount {discount:g} |
| `synthetic_action` | float32[4] | final pose minus this pose, in the units of `action` |

An action of 1 commands {limits[0]:g}, {limits[1]:g}, {limits[2]:g} m and {limits[3]:g} rad.

## Episodes

| column | type | meaning |
|---|---|---|
| `episode_id`, `block`, `seed` | int64 | of the attempt, of its block (attempts with the same objects), of its scene |
| `object_ids` | list of string | the objects in the bin, files in `objects/` |
| `object_poses` | list of float32[7] | x, y, z (m), qx, qy, qz, qw of each after settling |
| `steps` | int32 | number of steps |
| `end` | string | `height`: the gripper went below the height threshold; `T`: the last allowed step |
| `success`, `lifted_object` | bool, string | whether the attempt succeeded, and what was lifted |
| `policy`, `exploration` | string, float64 | what acted, and its exploration parameter |
| `final_pose` | float32[4] | x, y, z (m), phi (rad) after the last action, before the scripted descent |

`manifest.json` lists every file with its SHA-256 and all settings; `grasp-data verify` checks them.
"""


def card_text(manifest: Manifest) -> str:
    """Return the card of a dataset of at least one shard."""
    height, width, channels = manifest.image_shape
    return TEMPLATE.format(
        task=manifest.task_name,
        episodes=manifest.episodes,
        rows=manifest.rows,
        success=manifest.successes / manifest.episodes,
        size=_size_category(manifest.rows),
        objects=manifest.object_set["name"],
        height=height,
        width=width,
        image_bytes=height * width * channels,
        first_shard=steps_file(manifest.shards[0].name),
        discount=manifest.discount,
        limits=manifest.action_limits,
        steps_features=_features(STEPS_FEATURES),
        episodes_features=_features(EPISODES_FEATURES),
    )


def write_card(folder: Path, manifest: Manifest) -> Manifest:
    """Write `README.md` and list its digest in the manifest, which is saved and returned."""
    text = card_text(manifest)
    write_text(folder / CARD_NAME, text)
    digest = hashlib.sha256(text.encode()).hexdigest()
    updated = dataclasses.replace(manifest, files={**manifest.files, CARD_NAME: digest})
    updated.save(folder)
    return updated


STEPS_FEATURES: dict[str, object] = {
    "episode_id": "int64",
    "step": "int32",
    "image": "binary",
    "action": ("float32", 4),
    "reward": "float32",
    "terminal": "bool",
    "gripper_pose": ("float32", 4),
    "mc_return": "float32",
    "synthetic_action": ("float32", 4),
}
EPISODES_FEATURES: dict[str, object] = {
    "episode_id": "int64",
    "block": "int64",
    "seed": "int64",
    "object_ids": ("string", None),
    "object_poses": (("float32", 7), None),
    "steps": "int32",
    "end": "string",
    "success": "bool",
    "lifted_object": "string",
    "policy": "string",
    "exploration": "float64",
    "final_pose": ("float32", 4),
}


def _features(features: dict[str, object]) -> str:
    lines = []
    for name, kind in features.items():
        lines += [f"  - name: {name}", *(f"    {line}" for line in _feature(kind))]
    return "\n".join(lines)


def _feature(kind: object) -> list[str]:
    """Return the YAML lines of one type: a name, or a list (type, length) with length None where it varies."""
    if not isinstance(kind, tuple):
        return [f"dtype: {kind}"]
    inner, length = kind
    nested = _feature(inner)
    lines = [f"list: {inner}"] if not isinstance(inner, tuple) else ["list:", *(f"  {line}" for line in nested)]
    return lines + [f"length: {length}"] * (length is not None)


def _size_category(rows: int) -> str:
    return next((name for limit, name in SIZES + LARGER_SIZES if rows < limit), "n>100M")
