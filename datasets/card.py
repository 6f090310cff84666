"""The dataset card, `README.md`: read by people, and by Hugging Face `datasets`, which finds both tables by its header.

Its text depends on the manifest alone. The manifest lists its digest, so that `verify` covers it.
"""

import bisect
import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from graspq.common.files import write_text
from graspq.common.text import markdown
from graspq.datasets import columns
from graspq.datasets.columns import VARYING, Column, Sizes, quantities, sizes_of
from graspq.datasets.images import header
from graspq.datasets.manifest import Manifest, steps_file

CARD_NAME = "README.md"
SIZE_CATEGORIES = ("n<1K", "1K<n<10K", "10K<n<100K", "100K<n<1M", "1M<n<10M", "10M<n<100M", "n>100M")

# The types are declared, so that the images are images to Hugging Face `datasets` and its viewer.
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

An image is a PPM file: {header} bytes of header, then raw RGB. Any image library decodes it, and five lines of Python
give the images of a shard as numpy, `uint8 [N, {height}, {width}, 3]`, without a copy:

```python
import numpy as np
import pyarrow.parquet as pq
column = pq.read_table("{first_shard}", page_checksum_verification=True)["image"].combine_chunks()
files = np.frombuffer(column.buffers()[2], np.uint8).reshape(len(column), -1)
images = files[:, {header}:].reshape(-1, {height}, {width}, 3)
```

or row by row with Hugging Face `datasets`:

```python
from datasets import load_dataset
steps = load_dataset("path/of/this/folder", "steps", split="train")
steps[0]["image"].show()  # a Pillow image; with_format("torch") gives tensors
```

## Steps

{steps_table}
An action of 1 commands {limits}.

## Episodes

{episodes_table}
`manifest.json` lists every file with its SHA-256 and all settings; `grasp-data verify` checks them.
"""


def card_text(manifest: Manifest) -> str:
    """Return the card of a dataset of format 2 and at least one shard."""
    height, width, _ = manifest.image_shape
    action = manifest.action
    facts = {
        "action": ", ".join(action.names),
        "pose": quantities(action.pose, action.units, "{} ({})"),
        "discount": f"{manifest.discount:g}",
        "height": height,
        "width": width,
        "header": len(header(manifest.image_shape)),
    }
    sizes = sizes_of(manifest.image_shape, action)
    return TEMPLATE.format(
        **facts,
        task=manifest.task_name,
        episodes=manifest.episodes,
        rows=manifest.rows,
        success=manifest.successes / manifest.episodes,
        size=SIZE_CATEGORIES[bisect.bisect([10**power for power in range(3, 9)], manifest.rows)],
        objects=manifest.object_set["name"],
        first_shard=steps_file(manifest.shards[0].name),
        limits=quantities(action.limits, action.units),
        steps_features=_features(columns.STEPS, sizes),
        episodes_features=_features(columns.EPISODES, sizes),
        steps_table=_table(columns.STEPS, sizes, facts),
        episodes_table=_table(columns.EPISODES, sizes, facts),
    )


def write_card(folder: Path, manifest: Manifest) -> Manifest:
    """Write `README.md` and list its digest in the manifest, which is saved and returned."""
    text = card_text(manifest)
    write_text(folder / CARD_NAME, text)
    digest = hashlib.sha256(text.encode()).hexdigest()
    updated = dataclasses.replace(manifest, files={**manifest.files, CARD_NAME: digest})
    updated.save(folder)
    return updated


def _table(described: Sequence[Column], sizes: Sizes, facts: Mapping[str, object]) -> str:
    """Return the columns of a table as Markdown: name, type, meaning."""
    rows = [(f"`{column.name}`", _type(column, sizes), column.meaning.format(**facts)) for column in described]
    return markdown(("column", "type", "meaning"), rows)


def _type(column: Column, sizes: Sizes) -> str:
    dimensions = column.dimensions(sizes)
    if column.dtype == "uint8":
        return "PPM"
    varying = "list of " if VARYING in dimensions else ""
    return varying + column.dtype + "".join(f"[{size}]" for size in dimensions if size != VARYING)


def _features(described: Sequence[Column], sizes: Sizes) -> str:
    """Return the YAML lines that declare the types of a table."""
    lines = []
    for column in described:
        dtype = "image" if column.dtype == "uint8" else column.dtype
        dimensions = () if dtype == "image" else column.dimensions(sizes)
        lines += [f"  - name: {column.name}", *(f"    {line}" for line in _feature(dtype, dimensions))]
    return "\n".join(lines)


def _feature(dtype: str, dimensions: tuple[int, ...]) -> list[str]:
    if not dimensions:
        return [f"dtype: {dtype}"]
    length, *inner = dimensions
    nested = ["list:", *(f"  {line}" for line in _feature(dtype, tuple(inner)))] if inner else [f"list: {dtype}"]
    return nested + [f"length: {length}"] * (length != VARYING)
