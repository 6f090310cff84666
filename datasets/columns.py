"""The columns of a dataset's two tables, each stated once: schemas, card, batches and checks are made from here.

A new column is one entry in `STEPS` or `EPISODES`. Dimension key: T steps of an episode, A parts of an action,
K objects of an episode, H W C image.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from graspq.common.action_space import ActionSpace
from graspq.datasets import images
from graspq.datasets.episode import Episode
from graspq.datasets.labels import mc_return, synthetic_action
from graspq.datasets.manifest import Manifest

Row = Mapping[str, Any]
Sizes = Mapping[str, int]
RecordType = np.dtype[np.void]
VARYING = -1


@dataclasses.dataclass(frozen=True)
class Column:
    """What both tables say about a column.

    Attributes:
        name: of the column.
        dtype: of its numbers as numpy calls it, or `"string"`.
        shape: of its value in one row, in numbers and letters of the dimension key; K varies from row to row.
        meaning: a line of the dataset card; `{action}`, `{pose}`, `{discount}` and `{height}`, `{width}` are filled in.
        metadata: order, units and the like as JSON values, stored with the Parquet field.
        nullable: whether a row may hold nothing.
        since: the first format of a dataset that has it.
        in_format_1: its name there, where it has another now.
    """

    name: str
    dtype: str
    shape: tuple[str | int, ...]
    meaning: str
    metadata: Callable[[Manifest], dict[str, Any]] = lambda manifest: {}
    nullable: bool = False
    since: int = 1
    in_format_1: str | None = None

    def dimensions(self, sizes: Sizes) -> tuple[int, ...]:
        """Return its shape in numbers, `VARYING` for one that varies."""
        return tuple(size if isinstance(size, int) else sizes[size] for size in self.shape)

    def stored_name(self, format_version: int) -> str:
        """Return its name in the files of a format."""
        return self.in_format_1 if format_version == 1 and self.in_format_1 is not None else self.name

    def arrow_type(self, sizes: Sizes, format_version: int) -> pa.DataType:
        """Return its type in Parquet: bytes for an image (see `images`), lists for other arrays."""
        if self.dtype == "uint8":
            return pa.binary(math.prod(self.dimensions(sizes)) if format_version == 1 else -1)
        kind = pa.type_for_alias(self.dtype)
        for size in reversed(self.dimensions(sizes)):
            kind = pa.list_(pa.field("element", kind, nullable=False), size)
        return kind


@dataclasses.dataclass(frozen=True)
class EpisodeColumn(Column):
    """A column of the episodes table.

    Attributes:
        value: its value for an episode; the episode's attribute of that name where it is not given.
    """

    value: Callable[[Episode], Any] | None = None

    def of(self, episode: Episode) -> Any:
        """Return its value in the row of an episode: arrays as lists, an image as a PPM."""
        value = getattr(episode, self.name) if self.value is None else self.value(episode)
        if self.dtype == "uint8":
            return images.encoded(value)
        return value.tolist() if isinstance(value, np.ndarray) else value


@dataclasses.dataclass(frozen=True)
class StepColumn(Column):
    """A column of the steps table; it has a `value`, or a `label` that `verify` computes again from what is stored.

    Attributes:
        value: [T, ...] of an episode, measured.
        label: [T, ...] as a function of the measured columns, name → [T, ...], of the episode's row in the episodes
            table, and of the manifest.
        batches: whether batches carry it.
    """

    value: Callable[[Episode], Any] | None = None
    label: Callable[[Row, Row, Manifest], Any] | None = None
    batches: bool = True


def phi_range(manifest: Manifest) -> dict[str, Any]:
    """Return the range of the wrist's angle as metadata, where a pose has one."""
    return {} if manifest.phi_range is None else {"phi_range": list(manifest.phi_range)}


def _image(manifest: Manifest) -> dict[str, Any]:
    shape = {"shape": list(manifest.image_shape), "dtype": "uint8", "layout": "H W C", "color": "RGB"}
    return shape if manifest.format_version == 1 else shape | {"encoding": "PPM"}


def _action(manifest: Manifest) -> dict[str, Any]:
    limits = list(manifest.action.limits)
    return {"order": list(manifest.action.names), "unit": "action_limits", "action_limits": limits}


def _pose(manifest: Manifest) -> dict[str, Any]:
    return {"order": list(manifest.action.pose), "unit": list(manifest.action.units)}


def _gripper_pose(manifest: Manifest) -> dict[str, Any]:
    return _pose(manifest) | phi_range(manifest)


def _object_pose(manifest: Manifest) -> dict[str, Any]:
    return {"order": ["x", "y", "z", "qx", "qy", "qz", "qw"], "unit": "m, unit quaternion"}


def _discount(manifest: Manifest) -> dict[str, Any]:
    return {"discount": manifest.discount}


def _episode_id(steps: Row, episode: Row, manifest: Manifest) -> Any:
    return np.full(episode["steps"], episode["episode_id"])


def _step(steps: Row, episode: Row, manifest: Manifest) -> Any:
    return np.arange(episode["steps"])


def _terminal(steps: Row, episode: Row, manifest: Manifest) -> Any:
    return np.arange(episode["steps"]) == episode["steps"] - 1


def _mc_return(steps: Row, episode: Row, manifest: Manifest) -> Any:
    return mc_return(steps["reward"], manifest.discount)


def _synthetic_action(steps: Row, episode: Row, manifest: Manifest) -> Any:
    final_pose = np.asarray(episode["final_pose"], np.float32)
    return synthetic_action(steps["gripper_pose"], final_pose, manifest.action.limits)


# fmt: off
STEPS = (
    StepColumn("episode_id", "int64", (), "number of the attempt", label=_episode_id),
    StepColumn("step", "int32", (), "number of the step in its attempt, from 0", label=_step),
    StepColumn("image", "uint8", ("H", "W", "C"),
               "RGB before the action, {height} x {width} x 3 uint8, row by row behind the header",
               _image, value=lambda episode: episode.images),
    StepColumn("action", "float32", ("A",), "{action} in units of the action limits, in [-1, 1]",
               _action, value=lambda episode: episode.actions),
    StepColumn("reward", "float32", (), "1 for a successful grasp, at the last step only",
               value=lambda episode: episode.rewards),
    StepColumn("terminal", "bool", (),
               "whether this is the last step; the next image of every other row is that of the next row",
               label=_terminal),
    StepColumn("gripper_pose", "float32", ("A",), "{pose} before the action, angles unwrapped",
               _gripper_pose, value=lambda episode: episode.gripper_poses),
    StepColumn("mc_return", "float32", (), "discounted return from this step on, discount {discount}",
               _discount, label=_mc_return),
    StepColumn("synthetic_action", "float32", ("A",), "final pose minus this pose, in the units of `action`",
               _action, label=_synthetic_action),
)
EPISODES = (
    EpisodeColumn("episode_id", "int64", (), "number of the attempt"),
    EpisodeColumn("block", "int64", (), "number of its block: attempts that share their objects"),
    EpisodeColumn("seed", "int64", (), "seed of its scene"),
    EpisodeColumn("object_ids", "string", ("K",), "the objects in the bin, files in `objects/`"),
    EpisodeColumn("object_poses", "float32", ("K", 7), "x, y, z (m), qx, qy, qz, qw of each after settling",
                  _object_pose),
    EpisodeColumn("steps", "int32", (), "number of steps"),
    EpisodeColumn("ended_by", "string", (),
                  "`height`: the gripper went below the height threshold; `T`: the last allowed step",
                  in_format_1="end"),
    EpisodeColumn("success", "bool", (), "whether the attempt succeeded"),
    EpisodeColumn("lifted_object", "string", (), "what was lifted, if anything", nullable=True),
    EpisodeColumn("policy", "string", (), "what acted"),
    EpisodeColumn("exploration", "float64", (), "its exploration parameter"),
    EpisodeColumn("final_pose", "float32", ("A",), "{pose} after the last action, before the scripted descent", _pose),
    EpisodeColumn("final_image", "uint8", ("H", "W", "C"),
                  "RGB at the end, after the gripper has closed and lifted, {height} x {width} x 3 uint8",
                  _image, since=2),
)
# fmt: on


def sizes_of(image_shape: tuple[int, int, int], action: ActionSpace) -> Sizes:
    """Return the letters of the dimension key as numbers."""
    return {"A": action.size, "K": VARYING, **dict(zip("HWC", image_shape, strict=True))}


def record_dtype(image_shape: tuple[int, int, int], action: ActionSpace) -> RecordType:
    """Return the type of one step in memory, all its columns but the image; integers as int64, as torch indexes."""
    sizes = sizes_of(image_shape, action)
    columns = [column for column in STEPS if column.name != "image"]
    fields = [(column.name, column.dtype.replace("int32", "int64"), column.dimensions(sizes)) for column in columns]
    return np.dtype([*fields, ("block", "int64")])


def batch_columns() -> list[str]:
    """Return the names of the columns that batches carry besides the image."""
    return [*(column.name for column in STEPS if column.batches and column.name != "image"), "block"]


def current_names(stored: Sequence[str]) -> list[str]:
    """Return the names of the episodes table's columns, whichever format they are stored in."""
    former = {column.in_format_1: column.name for column in EPISODES}
    return [former.get(name, name) for name in stored]


def episode_row(episode: Episode, format_version: int) -> dict[str, Any]:
    """Return the row of an episode in the episodes table, columns as a format stores them."""
    described = [column for column in EPISODES if column.since <= format_version]
    return {column.stored_name(format_version): column.of(episode) for column in described}


def step_values(episode: Episode, manifest: Manifest) -> dict[str, Any]:
    """Return the columns of an episode's steps, [T, ...] each."""
    row = episode_row(episode, manifest.format_version)
    values = {column.name: column.value(episode) for column in STEPS if column.value is not None}
    for column in STEPS:
        if column.label is not None:
            values[column.name] = column.label(values, row, manifest)
    return values


def wrong_labels(steps: Row, row: Row, manifest: Manifest) -> list[str]:
    """Return the names of the labels that are not those of the stored columns.

    Args:
        steps: the stored columns of one episode's steps but the image, name → [T, ...].
        row: its row in the episodes table.
        manifest: of its dataset.
    """
    return [
        column.name
        for column in STEPS
        if column.label is not None and not np.array_equal(steps[column.name], column.label(steps, row, manifest))
    ]


def quantities(parts: Sequence[object], units: Sequence[str], form: str = "{} {}") -> str:
    """Return parts with their units, each unit once: `x, y, z m, phi rad`."""
    groups: list[tuple[list[str], str]] = []
    for part, unit in zip(parts, units, strict=True):
        text = f"{part:g}" if isinstance(part, float) else str(part)
        if groups and groups[-1][1] == unit:
            groups[-1][0].append(text)
        else:
            groups.append(([text], unit))
    return ", ".join(form.format(", ".join(texts), unit) for texts, unit in groups)
