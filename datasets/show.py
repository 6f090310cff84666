"""Film strips of episodes as a picture: each step's frame, the action taken in it, its reward and its return.

One row is one episode, one column one step; green rows succeeded.
"""

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpecFromSubplotSpec

from graspq.common.errors import UserError
from graspq.common.files import committed
from graspq.common.seeding import generator
from graspq.common.text import counted
from graspq.datasets.dataset import Shard, open_shards
from graspq.datasets.episode import Episode
from graspq.datasets.labels import mc_return
from graspq.datasets.manifest import Manifest

SUCCESS, FAILURE, MUTED, INK = "#1b8a4b", "#a8493f", "#8a8f98", "#22262b"
ACTION_COLORS = ("#3b6fb6", "#2a9d8f", "#d98324", "#8457a8", "#b0568c", "#6f7f2f", "#4aa3c7", "#8c5a3c")
CELL, HEADER, TITLE = 1.05, 0.34, 0.72


def choose_episodes(folder: Path, count: int, seed: int, success: bool | None = None) -> list[Episode]:
    """Return episodes drawn at random, in their order.

    Args:
        folder: the dataset.
        count: how many, fewer where there are fewer.
        seed: the choice is a function of it.
        success: only successful ones, only failed ones, or None for either.

    Raises:
        UserError: there is none, or a file is damaged.
    """
    shards = Shard.all_of(folder)
    rng = generator("datasets/show", seed)
    per_shard = -(-count // max(1, len(shards)))
    chosen: list[tuple[int, Path, int]] = []
    spare: list[tuple[int, Path, int]] = []
    for shard in (shards[index] for index in rng.permutation(len(shards))):
        fitting = [
            (row["episode_id"], shard.steps, number)
            for number, row in enumerate(shard.episode_rows())
            if success in (None, row["success"])
        ]
        order = [fitting[place] for place in rng.permutation(len(fitting))]
        taken = min(per_shard, count - len(chosen))
        chosen, spare = chosen + order[:taken], spare + order[taken:count]
        if len(chosen) == count:
            break
    chosen += spare[: count - len(chosen)]
    if not chosen:
        kind = {None: "", True: "successful ", False: "failed "}[success]
        raise UserError(f"{folder}: there is no {kind}episode to show")
    return [open_shards([path])[number] for _, path, number in sorted(chosen)]


@matplotlib.rc_context({"text.parse_math": False})  # names are names, whatever they hold
def save_strips(path: Path, episodes: Sequence[Episode], manifest: Manifest, title: str) -> None:
    """Draw the strips and write them to `path` as PNG.

    Raises:
        UserError: the file cannot be written.
    """
    figure = draw_strips(episodes, manifest, title)
    try:
        with committed(path) as temporary:
            figure.savefig(temporary, format="png", dpi=160, facecolor="white")
    except OSError as error:
        raise UserError(f"{path}: cannot write the picture ({error.strerror}); choose another --out") from None


def draw_strips(episodes: Sequence[Episode], manifest: Manifest, title: str) -> Figure:
    """Return the figure of the strips, one row each; `manifest` is that of their dataset."""
    columns = max(episode.steps for episode in episodes)
    row_height = HEADER + CELL * 1.62
    width, height = max(6.0, 0.5 + columns * CELL * 1.04), TITLE + len(episodes) * row_height + 0.15
    figure = Figure(figsize=(width, height))
    figure.text(0.25 / width, 1 - 0.28 / height, title, fontsize=11, weight="bold", color=INK, va="center")
    _legend(figure, manifest.action.names, width, height)
    for index, episode in enumerate(episodes):
        returns = mc_return(episode.rewards, manifest.discount)
        top = 1 - (TITLE + index * row_height) / height
        _header(figure, episode, 0.25 / width, top - 0.16 / height)
        bottom = 1 - (TITLE + (index + 1) * row_height - 0.1) / height
        right = (0.25 + columns * CELL * 1.04) / width
        area = figure.add_gridspec(
            1, columns, left=0.25 / width, right=right, top=top - HEADER / height, bottom=bottom, wspace=0.05
        )
        for step in range(episode.steps):
            cell = area[0, step].subgridspec(3, 1, height_ratios=(1.0, 0.3, 0.2), hspace=0.06)
            _cell(figure, cell, episode, step, float(returns[step]))
    return figure


def _legend(figure: Figure, names: Sequence[str], width: float, height: float) -> None:
    left, line = 0.25 / width, 1 - 0.52 / height
    for number, name in enumerate(names):
        shown, color = name.replace("phi", "φ"), ACTION_COLORS[number % len(ACTION_COLORS)]
        figure.text(left, line, f"■ {shown}", fontsize=7.5, color=color, va="center")
        left += (0.24 + 0.06 * len(shown)) / width
    meaning = "action in units of its limits, −1 to 1    r reward    R return (mc_return)"
    figure.text(left + 0.08 / width, line, meaning, fontsize=7.5, color=MUTED, va="center")


def _header(figure: Figure, episode: Episode, left: float, line: float) -> None:
    outcome = "success" if episode.success else "failure"
    lifted = f"lifted {episode.lifted_object}" if episode.lifted_object is not None else "nothing lifted"
    steps = counted(episode.steps, "step")
    text = f"{outcome} · episode {episode.episode_id} · {steps}, ended by {episode.ended_by} · {lifted}"
    figure.text(left, line, text, fontsize=8, color=_color(episode), weight="bold", va="center")


def _color(episode: Episode) -> str:
    return SUCCESS if episode.success else FAILURE


def _cell(figure: Figure, cell: GridSpecFromSubplotSpec, episode: Episode, step: int, value: float) -> None:
    frame: Axes = figure.add_subplot(cell[0])
    frame.imshow(episode.images[step], interpolation="nearest", aspect="equal")
    frame.set(xticks=[], yticks=[])
    terminal, action = step == episode.steps - 1, episode.actions[step]
    for spine in frame.spines.values():
        spine.set(color=_color(episode) if terminal else "#d5d8dc", linewidth=2.0 if terminal else 0.6)
    frame.text(
        0.04, 0.95, str(step), transform=frame.transAxes, fontsize=6.5, color="white", va="top",
        bbox={"facecolor": "#000000a0", "edgecolor": "none", "pad": 1.2},
    )  # fmt: skip
    bars: Axes = figure.add_subplot(cell[1])
    size = len(action)
    bars.bar(
        np.arange(size),
        action,
        color=[ACTION_COLORS[part % len(ACTION_COLORS)] for part in range(size)],
        width=0.72,
    )
    bars.axhline(0, color="#c5c9cf", linewidth=0.6, zorder=0)
    bars.set(xlim=(-0.9, size - 0.1), ylim=(-1.08, 1.08), xticks=[], yticks=[])
    bars.set_frame_on(False)
    label: Axes = figure.add_subplot(cell[2])
    label.axis("off")
    color = _color(episode) if terminal else MUTED
    text = f"r {episode.rewards[step]:g}   R {value:.2g}"
    label.text(0.5, 0.6, text, fontsize=6.8, color=color, ha="center", va="center")
