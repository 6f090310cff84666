"""The contact sheet of an object set: every object in its likeliest resting pose, at one scale, labelled."""

import math
from pathlib import Path
from typing import Any

import matplotlib
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
# Inches: of a picture, of the label below it, of the heading.
_CELL, _LABEL, _HEAD = 1.55, 0.42, 0.75
_INK, _PALE = "#22262e", "#6b7280"


@matplotlib.rc_context({"text.parse_math": False})  # names are names, whatever they hold
def contact_sheet(
    object_set: ObjectSet, out: Path, *, split: str | None = None, count: int | None = None, by_family: int = 0
) -> int:
    """Draw a labelled contact sheet as a PNG and return how many objects it shows.

    Args:
        object_set: any set.
        out: the PNG; its folder is made if need be.
        split: only this split; None for all.
        count: at most so many, the first of the set's order; None for all.
        by_family: instead so many of each main family, if above 0; the families follow each other by name.

    Raises:
        UserError: no such split, `out` is no PNG or cannot be written, or a mesh is unreadable.
    """
    if out.suffix.lower() != ".png":
        raise UserError(f"{out}: expected a file name that ends in .png")
    ids = object_set.ids(split)
    which = f"split {split}" if split is not None else "all splits"
    shown = _first_of_families(object_set, ids, by_family) if by_family else ids[:count]
    figure = _figure(object_set, shown, f"{which} · {len(shown)} of {len(ids)} · one scale", max(by_family, 1))
    try:
        with committed(out) as temporary:
            figure.savefig(temporary, format="png", dpi=_CELL_PIXELS / _CELL, facecolor=BACKGROUND)
    except OSError as error:
        raise UserError(f"{out}: cannot write the picture here ({error.strerror}); choose another file") from None
    return len(shown)


def _first_of_families(object_set: ObjectSet, ids: tuple[str, ...], count: int) -> tuple[str, ...]:
    families: dict[str, list[str]] = {}
    for object_id in ids:
        families.setdefault(object_set[object_id].family, []).append(object_id)
    return tuple(object_id for name in sorted(families) for object_id in families[name][:count])


def _figure(object_set: ObjectSet, ids: tuple[str, ...], subtitle: str, together: int) -> Figure:
    columns = _columns(len(ids), together)
    wide = max(columns, 3) * _CELL
    high = _HEAD + math.ceil(len(ids) / columns) * (_CELL + _LABEL) + 0.1
    figure = Figure(figsize=(wide, high))
    scenes = {name: _scene(object_set, name) for name in ids}
    # Metres across a picture.
    cover = 1.22 * max(_span(parts) for parts in scenes.values())
    for place, name in enumerate(ids):
        row, column = divmod(place, columns)
        left, bottom = (wide - columns * _CELL) / 2 + column * _CELL, high - _HEAD - row * (_CELL + _LABEL) - _CELL
        axes = figure.add_axes((left / wide, bottom / high, _CELL / wide, _CELL / high))
        axes.imshow(draw(scenes[name], object_set[name].color, _CELL_PIXELS, cover), interpolation="none")
        axes.set_axis_off()
        _label(axes, object_set[name])
    figure.text(
        0.18 / wide, 1 - 0.17 / high, f"{object_set.name} objects", va="top", size=12, color=_INK, weight="bold"
    )
    figure.text(0.18 / wide, 1 - 0.43 / high, subtitle, va="top", size=7.5, color=_PALE)
    _scale_bar(figure, cover)
    return figure


def _columns(count: int, together: int) -> int:
    """Return the number of columns of a sheet somewhat wider than high, with few empty places in its last row.

    It is a multiple of the number of objects that stay together.
    """
    ideal = max(2, round(math.sqrt(1.5 * count) / together))
    return together * min(range(ideal, ideal + 3), key=lambda columns: (-count % (columns * together), columns))


def _scene(object_set: ObjectSet, object_id: str) -> list[trimesh.Trimesh]:
    parts = object_set.parts_of(object_id)
    pose = resting_poses(np.concatenate([part.vertices for part in parts]), np.zeros(3))[0]
    return standing(parts, pose.up)


def _span(parts: list[trimesh.Trimesh]) -> float:
    points = np.concatenate([part.vertices for part in parts])
    return float(max(2 * np.linalg.norm(points[:, :2], axis=1).max(), np.ptp(points[:, 2])))


def _label(axes: Axes, record: ObjectRecord) -> None:
    counts = {name: record.families.count(name) for name in record.families}
    families = " + ".join(f"{count} {name}" if count > 1 else name for name, count in counts.items())
    size = f"{100 * max(record.extents):.1f} cm · {1000 * record.mass:.0f} g"
    style: dict[str, Any] = {"transform": axes.transAxes, "ha": "center", "va": "top"}
    axes.text(0.5, 0.02, record.object_id, size=7.0, color=_INK, weight="bold", **style)
    axes.text(0.5, -0.065, families, size=5.2, color=_INK, **style)
    axes.text(0.5, -0.15, size, size=5.2, color=_PALE, **style)


def _scale_bar(figure: Figure, cover: float) -> None:
    """Draw a bar as long as 5 or 10 cm across a picture; depth is foreshortened, widths are not."""
    wide, high = figure.get_size_inches()
    centimetres = 5 if cover < 0.5 else 10
    right, level = wide - 0.2, high - 0.36
    left = right - centimetres / 100 / cover * _CELL
    axes = figure.add_axes((0, 0, 1, 1), frameon=False)
    axes.set(xlim=(0, wide), ylim=(0, high))
    axes.set_axis_off()
    axes.errorbar(
        (left + right) / 2, level, xerr=(right - left) / 2, color=_INK, elinewidth=1.6, capsize=3, capthick=1.0
    )
    axes.text((left + right) / 2, level + 0.06, f"{centimetres} cm", ha="center", va="bottom", size=7, color=_INK)
