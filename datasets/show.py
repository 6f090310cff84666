"""Film strips of episodes as a picture: each step's frame, the action taken in it, its reward and its return.

One row is one episode, one column one step; green rows succeeded.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpecFromSubplotSpec

from graspq.common.errors import UserError
from graspq.common.files import committed
from graspq.common.seeding import generator
from graspq.datasets.batch import Records
from graspq.datasets.dataset import Dataset
from graspq.datasets.episode import UInt8
from graspq.datasets.manifest import ShardEntry

SUCCESS, FAILURE, MUTED, INK = "#1b8a4b", "#a8493f", "#8a8f98", "#22262b"
ACTION_COLORS = ("#3b6fb6", "#2a9d8f", "#d98324", "#8457a8", "#b0568c", "#6f7f2f", "#4aa3c7", "#8c5a3c")
CELL, HEADER, TITLE = 1.05, 0.34, 0.72


@dataclass(frozen=True, eq=False)
class Strip:
    """One episode to be drawn: its row in the episodes table, images uint8 [T, H, W, 3], records [T]."""

    row: dict[str, Any]
    images: UInt8
    records: Records


def choose_strips(dataset: Dataset, episodes: int, seed: int, success: bool | None = None) -> list[Strip]:
    """Return episodes drawn at random, in their order.

    Args:
        dataset: where from.
        episodes: how many, fewer where there are fewer.
        seed: the choice is a function of it.
        success: only successful ones, only failed ones, or None for either.

    Raises:
        UserError: there is none, or a file is damaged.
    """
    entries = dataset.manifest.shards
    rng = generator("datasets/show", seed)
    per_shard = -(-episodes // max(1, len(entries)))
    chosen: list[Strip] = []
    spare: list[tuple[ShardEntry, dict[str, Any]]] = []
    for index in rng.permutation(len(entries)):
        rows = [row for row in dataset.episode_rows(entries[index]) if success is None or row["success"] == success]
        order = [rows[number] for number in rng.permutation(len(rows))]
        wanted = min(per_shard, episodes - len(chosen))
        chosen += _read(dataset, entries[index], order[:wanted])
        spare += [(entries[index], row) for row in order[wanted:episodes]]
        if len(chosen) == episodes:
            break
    for entry, row in spare[: episodes - len(chosen)]:
        chosen += _read(dataset, entry, [row])
    if not chosen:
        kind = {None: "", True: "successful ", False: "failed "}[success]
        raise UserError(f"{dataset.folder}: there is no {kind}episode to show")
    return sorted(chosen, key=lambda strip: int(strip.row["episode_id"]))


def _read(dataset: Dataset, entry: ShardEntry, rows: list[dict[str, Any]]) -> list[Strip]:
    if not rows:
        return []
    pool = dataset.shard_pool(entry)
    strips = []
    for row in rows:
        block = pool.read_block(pool.blocks[row["block"] - entry.first_block])
        here = block.records["episode_id"] == row["episode_id"]
        strips.append(Strip(row, block.images[here], block.records[here]))
    return strips


def save_strips(path: Path, strips: Sequence[Strip], names: Sequence[str], title: str) -> None:
    """Draw the strips and write them to `path` as PNG.

    Raises:
        UserError: the file cannot be written.
    """
    figure = draw_strips(strips, names, title)
    try:
        with committed(path) as temporary:
            figure.savefig(temporary, format="png", dpi=160, facecolor="white")
    except OSError as error:
        raise UserError(f"{path}: cannot write the picture ({error.strerror}); choose another --out") from None


def draw_strips(strips: Sequence[Strip], names: Sequence[str], title: str) -> Figure:
    """Return the figure of the strips, one row each; `names` are those of the parts of an action."""
    columns = max(len(strip.records) for strip in strips)
    row_height = HEADER + CELL * 1.62
    width, height = max(6.0, 0.5 + columns * CELL * 1.04), TITLE + len(strips) * row_height + 0.15
    figure = Figure(figsize=(width, height))
    figure.text(0.25 / width, 1 - 0.28 / height, title, fontsize=11, weight="bold", color=INK, va="center")
    _legend(figure, names, width, height)
    for index, strip in enumerate(strips):
        top = 1 - (TITLE + index * row_height) / height
        _header(figure, strip, 0.25 / width, top - 0.16 / height)
        bottom = 1 - (TITLE + (index + 1) * row_height - 0.1) / height
        right = (0.25 + columns * CELL * 1.04) / width
        area = figure.add_gridspec(
            1, columns, left=0.25 / width, right=right, top=top - HEADER / height, bottom=bottom, wspace=0.05
        )
        for step in range(len(strip.records)):
            _cell(figure, area[0, step].subgridspec(3, 1, height_ratios=(1.0, 0.3, 0.2), hspace=0.06), strip, step)
    return figure


def _legend(figure: Figure, names: Sequence[str], width: float, height: float) -> None:
    left, line = 0.25 / width, 1 - 0.52 / height
    for number, name in enumerate(names):
        shown, color = name.replace("phi", "φ"), ACTION_COLORS[number % len(ACTION_COLORS)]
        figure.text(left, line, f"■ {shown}", fontsize=7.5, color=color, va="center")
        left += (0.24 + 0.06 * len(shown)) / width
    meaning = "action in units of its limits, −1 to 1    r reward    R return (mc_return)"
    figure.text(left + 0.08 / width, line, meaning, fontsize=7.5, color=MUTED, va="center")


def _header(figure: Figure, strip: Strip, left: float, line: float) -> None:
    row = strip.row
    outcome = "success" if row["success"] else "failure"
    lifted = f"lifted {row['lifted_object']}" if row["lifted_object"] is not None else "nothing lifted"
    steps = "1 step" if row["steps"] == 1 else f"{row['steps']} steps"
    text = f"{outcome} · episode {row['episode_id']} · {steps}, ended by {row['end']} · {lifted}"
    figure.text(left, line, text, fontsize=8, color=_color(strip), weight="bold", va="center")


def _color(strip: Strip) -> str:
    return SUCCESS if strip.row["success"] else FAILURE


def _cell(figure: Figure, cell: GridSpecFromSubplotSpec, strip: Strip, step: int) -> None:
    frame: Axes = figure.add_subplot(cell[0])
    frame.imshow(strip.images[step], interpolation="nearest", aspect="equal")
    frame.set(xticks=[], yticks=[])
    record = strip.records[step]
    for spine in frame.spines.values():
        spine.set(
            color=_color(strip) if record["terminal"] else "#d5d8dc", linewidth=2.0 if record["terminal"] else 0.6
        )
    frame.text(
        0.04, 0.95, str(int(record["step"])), transform=frame.transAxes, fontsize=6.5, color="white", va="top",
        bbox={"facecolor": "#000000a0", "edgecolor": "none", "pad": 1.2},
    )  # fmt: skip
    bars: Axes = figure.add_subplot(cell[1])
    size = len(record["action"])
    bars.bar(
        np.arange(size),
        record["action"],
        color=[ACTION_COLORS[part % len(ACTION_COLORS)] for part in range(size)],
        width=0.72,
    )
    bars.axhline(0, color="#c5c9cf", linewidth=0.6, zorder=0)
    bars.set(xlim=(-0.9, size - 0.1), ylim=(-1.08, 1.08), xticks=[], yticks=[])
    bars.set_frame_on(False)
    label: Axes = figure.add_subplot(cell[2])
    label.axis("off")
    color = _color(strip) if record["terminal"] else MUTED
    text = f"r {record['reward']:g}   R {record['mc_return']:.2g}"
    label.text(0.5, 0.6, text, fontsize=6.8, color=color, ha="center", va="center")
