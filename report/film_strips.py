"""The film strips of a report: what policies saw in some evaluated episodes, as pictures inside the page."""

import base64
import io
from typing import Any

import numpy as np
from PIL import Image

from graspq.common.text import counted
from graspq.evaluate.films import Film, read_films
from graspq.report.findings import Findings
from graspq.report.rows import rows_of


def film_groups(findings: Findings) -> list[dict[str, Any]]:
    """Return the film strips, grouped by policy; those of candidates stand open."""
    groups = []
    for (task, split, *_), scores in findings.panels.items():
        # Of several training seeds those of the first.
        for score in (
            row.scores[0] for row in sorted(rows_of(scores), key=lambda row: (row.is_reference, -row.rate.value))
        ):
            films = read_films(score.evaluations[0])
            if films:
                drawn = [_film(film) for film in films]
                scenes = f"{task} task, {split} split"
                groups.append({"name": score.name, "scenes": scenes, "films": drawn, "open": not score.is_reference})
    return groups


def _film(film: Film) -> dict[str, Any]:
    row = film.row
    what = f"lifted {row.lifted_object}" if row.lifted_object is not None else "lifted nothing"
    where = "near the floor" if row.ended_by == "height" else "at the last step"
    q = f", Q {row.q:.2f}" if row.q is not None else ""
    frames = []
    for index, frame in enumerate(film.frames):
        last = index == len(film.frames) - 1
        caption = "after the lift" if last else f"t = {index}"
        alt = "Bin after the lift" if last else f"Bin before action {index + 1}"
        height, width = frame.shape[:2]
        frames.append({"png": _png(frame), "alt": alt, "caption": caption, "width": width, "height": height})
    return {
        "success": row.success,
        "caption": f"episode {row.episode}: closed {where} after {counted(row.steps, 'action')}{q}; {what}",
        "frames": frames,
    }


def _png(frame: np.ndarray) -> str:
    """Return uint8 [H, W, 3] as a PNG in base64."""
    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, format="PNG", optimize=True)
    return base64.b64encode(buffer.getvalue()).decode()
