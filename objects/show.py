"""The contact sheet of an object set: every object in its likeliest resting pose, at one scale, labelled.

Drawn with matplotlib and `drawing.py`; it needs no simulator.
"""

import math
from pathlib import Path

import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from graspq.common.errors import UserError
from graspq.common.files import committed
from graspq.objects.drawing import BACKGROUND, draw, standing
from graspq.objects.object_set import ObjectRecord, ObjectSet
from graspq.objects.resting import resting_poses

_CELL_PIXELS = 232
_CELL_INCHES = 1.55
_LABEL_INCHES = 0.42
_HEAD_INCHES = 0.75
_INK, _PALE = "#22262e", "#6b7280"


def contact_sheet(object_set: ObjectSet, out: Path, *, split: str | None = None, count: int | None = None) -> int:
    """Draw a labelled contact sheet as a PNG and return how many objects it shows.

    Args:
        object_set: any set.
        out: the PNG; its folder is made if need be.
        split: only this split; None for all.
        count: at most so many, the first of the set's order; None for all.

    Raises:
        UserError: no such split, `out` is no PNG or cannot be written, or a mesh is unreadable.
    """
    if out.suffix.lower() != ".png":
        raise UserError(f"{out}: expected a file name that ends in .png")
    ids = object_set.ids(split)[:count]
    figure = _figure(object_set, ids, f"split {split}" if split is not None else "all splits", split)
    try:
        with committed(out) as temporary:
            figure.savefig(temporary, format="png", dpi=_CELL_PIXELS / _CELL_INCHES, facecolor=BACKGROUND)
    except OSError as error:
        raise UserError(f"{out}: cannot write the picture here ({error.strerror}); choose another file") from None
    return len(ids)


def _figure(object_set: ObjectSet, ids: tuple[str, ...], which: str, split: str | None) -> Figure:
    columns = _columns(len(ids))
    rows = math.ceil(len(ids) / columns)
    row_inches = _CELL_INCHES + _LABEL_INCHES
    wide, high = max(columns, 3) * _CELL_INCHES, _HEAD_INCHES + rows * row_inches + 0.1
    figure = Figure(figsize=(wide, high))
    scenes = {name: _scene(object_set, name) for name in ids}
    cover = 1.22 * max(_span(parts) for parts in scenes.values())
    left = (wide - columns * _CELL_INCHES) / 2
    for place, name in enumerate(ids):
        row, column = divmod(place, columns)
        bottom = high - _HEAD_INCHES - row * row_inches - _CELL_INCHES
        corner = (left + column * _CELL_INCHES) / wide, bottom / high
        axes = figure.add_axes((*corner, _CELL_INCHES / wide, _CELL_INCHES / high))
        axes.imshow(draw(scenes[name], object_set[name].color, _CELL_PIXELS, cover), interpolation="none")
        axes.set_axis_off()
        _label(axes, object_set[name])
    total = len(object_set.ids(split))
    _heading(figure, f"{object_set.name} objects", f"{which} · {len(ids)} of {total} · one scale", cover)
    return figure


def _columns(count: int) -> int:
    """Return the number of columns of a sheet somewhat wider than high, with few empty places in its last row."""
    ideal = max(2, round(math.sqrt(1.5 * count)))
    return min(range(ideal, ideal + 3), key=lambda columns: (-count % columns, columns))


def _scene(object_set: ObjectSet, object_id: str) -> list[trimesh.Trimesh]:
    parts = object_set.parts_of(object_id)
    pose = resting_poses(np.concatenate([part.vertices for part in parts]), np.zeros(3))[0]
    return standing(parts, pose.up)


def _span(parts: list[trimesh.Trimesh]) -> float:
    points = np.concatenate([part.vertices for part in parts])
    return float(max(2 * np.linalg.norm(points[:, :2], axis=1).max(), np.ptp(points[:, 2])))


def _label(axes: Axes, record: ObjectRecord) -> None:
    names = dict.fromkeys(record.families)
    counts = [f"{record.families.count(name)} {name}" if record.families.count(name) > 1 else name for name in names]
    longest, grams = 100 * max(record.extents), 1000 * record.mass
    lines = [
        (record.object_id, 7.0, _INK, "bold"),
        (" + ".join(counts), 5.2, _INK, "normal"),
        (f"{longest:.1f} cm · {grams:.0f} g", 5.2, _PALE, "normal"),
    ]
    for number, (text, size, color, weight) in enumerate(lines):
        axes.text(
            0.5, 0.02 - 0.085 * number, text, transform=axes.transAxes, ha="center", va="top",
            fontsize=size, color=color, fontweight=weight,
        )  # fmt: skip


def _heading(figure: Figure, title: str, subtitle: str, cover: float) -> None:
    wide, high = figure.get_size_inches()
    figure.text(0.18 / wide, 1 - 0.17 / high, title, va="top", fontsize=12, color=_INK, fontweight="bold")
    figure.text(0.18 / wide, 1 - 0.43 / high, subtitle, va="top", fontsize=7.5, color=_PALE)
    # The bar is as long as 5 cm across the picture; depth is foreshortened, widths are not.
    centimetres = 5 if cover < 0.5 else 10
    length = centimetres / 100 / cover * _CELL_INCHES
    end, level = wide - 0.2, high - 0.36
    axes = figure.add_axes((0, 0, 1, 1), frameon=False)
    axes.set_axis_off()
    axes.set_xlim(0, wide)
    axes.set_ylim(0, high)
    axes.plot([end - length, end], [level, level], color=_INK, linewidth=1.6, solid_capstyle="butt")
    for x in (end - length, end):
        axes.plot([x, x], [level - 0.04, level + 0.04], color=_INK, linewidth=1.0)
    axes.text(end - length / 2, level + 0.06, f"{centimetres} cm", ha="center", va="bottom", fontsize=7, color=_INK)
