"""Any mesh as convex parts: convex pieces are kept, others decomposed (V-HACD), flat ones refused.

Bullet collides with convex hulls only, and advises against more than about 100 points in one.
"""

import math
from pathlib import Path

import numpy as np
import trimesh

from graspq.common.errors import UserError
from graspq.objects.geometry import Array, convex_hull

MOST_PARTS = 16
MOST_VERTICES = 64
# A piece that fills so much of its hull counts as convex: published hulls have rounded corners.
_CONVEX = 0.99
# Less volume than this share of a cube over the longest side is none.
_FLAT = 1e-6


def convex_parts(meshes: list[trimesh.Trimesh], path: Path) -> tuple[list[trimesh.Trimesh], tuple[str, ...]]:
    """Return the convex parts of an object and its families: "convex" where pieces were kept, "decomposed" where not.

    Loose pieces are taken one by one; where one is flat (a model of thin sheets), all are decomposed together.

    Args:
        meshes: of one body, metres.
        path: for messages.

    Raises:
        UserError: all of them together are flat.
    """
    loose = [piece for mesh in meshes for piece in mesh.split(only_watertight=False)]
    if not loose or any(_is_flat(piece) for piece in loose):
        loose = [trimesh.util.concatenate(meshes)]
    if _is_flat(loose[0]):
        raise UserError(f"{path}: a flat mesh without volume; give it some thickness or remove it")
    parts: list[trimesh.Trimesh] = []
    families: list[str] = []
    for piece in loose:
        kept = _is_convex(piece)
        parts += [coarse_hull(piece.vertices)] if kept else _decomposed(piece)
        families.append("convex" if kept else "decomposed")
    return parts, tuple(dict.fromkeys(families))


def _is_flat(piece: trimesh.Trimesh) -> bool:
    try:
        hull = convex_hull(piece.vertices)
    except ValueError:
        return True
    return bool(hull.volume < _FLAT * float(np.ptp(piece.vertices, axis=0).max()) ** 3)


def _is_convex(piece: trimesh.Trimesh) -> bool:
    """Return whether a piece fills its convex hull, to 1 %: published hulls have rounded corners."""
    hull = convex_hull(piece.vertices)
    return bool(piece.is_convex or (piece.is_watertight and abs(piece.volume) >= _CONVEX * hull.volume))


def _decomposed(piece: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Return at most 16 convex parts that approximate a non-convex mesh (V-HACD)."""
    # One thread, so that two runs agree.
    found = piece.convex_decomposition(
        maxConvexHulls=MOST_PARTS, maxNumVerticesPerCH=MOST_VERTICES // 2, asyncACD=False
    )
    return [coarse_hull(part.vertices) for part in found if not _is_flat(part)]


def coarse_hull(points: Array) -> trimesh.Trimesh:
    """Return the convex hull of `points` [V, 3]; of more than 64 corners the extremes in 64 directions.

    Raises:
        ValueError: the points span no volume.
    """
    hull = convex_hull(np.unique(np.asarray(points, dtype=np.float64), axis=0))
    if len(hull.vertices) <= MOST_VERTICES:
        return hull
    steps = np.arange(MOST_VERTICES) + 0.5
    height, angle = 1 - 2 * steps / MOST_VERTICES, steps * math.pi * (3 - math.sqrt(5))
    flat = np.sqrt(1 - height**2)
    directions = np.stack([flat * np.cos(angle), flat * np.sin(angle), height], axis=1)
    return convex_hull(hull.vertices[np.unique((hull.vertices @ directions.T).argmax(axis=0))])
