"""Frames of some evaluated episodes, kept for the report: a few successes and a few failures.

Which ones is decided by the index of the episode alone, so that the same evaluation keeps the same films.
"""

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graspq.common.checksums import DamagedError
from graspq.common.files import committed
from graspq.evaluate.records import EVAL_FILE, FILMS_FILE, REMEDY, EpisodeRow, Evaluation


@dataclass(frozen=True)
class Film:
    """The frames of one episode.

    Attributes:
        row: what happened in it.
        frames: uint8 [T + 1, H, W, 3] RGB: before each action, and after the lift.
    """

    row: EpisodeRow
    frames: np.ndarray


class FilmKeeper:
    """Keeps the first successes and the first failures, by index, in whatever order episodes end."""

    def __init__(self, count: int) -> None:
        """Keep at most `count` films."""
        self.count = count
        self._kept: dict[bool, dict[int, Film]] = {True: {}, False: {}}

    def offer(self, film: Film) -> None:
        """Consider an episode that has ended."""
        if self.count == 0:
            return
        kept, index = self._kept[film.row.success], film.row.episode
        if len(kept) < self.count or index < max(kept):
            kept[index] = film
            if len(kept) > self.count:
                del kept[max(kept)]

    def chosen(self) -> list[Film]:
        """Return the films, as many successes as failures where there are enough of both, in the order of episodes."""
        good, bad = (self._kept[success] for success in (True, False))
        wanted_bad = min(len(bad), max(self.count // 2, self.count - len(good)))
        wanted_good = min(len(good), self.count - wanted_bad)
        picked = {index: good[index] for index in sorted(good)[:wanted_good]}
        picked |= {index: bad[index] for index in sorted(bad)[:wanted_bad]}
        return [picked[index] for index in sorted(picked)]


def write_films(folder: Path, films: Sequence[Film]) -> None:
    """Write `films.npz` atomically: all frames in one array, and for each episode its index and number of frames.

    Without films an older file is removed.
    """
    path = folder / FILMS_FILE
    if not films:
        path.unlink(missing_ok=True)
        return
    with committed(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            frames=np.concatenate([film.frames for film in films]),
            episodes=np.array([film.row.episode for film in films], dtype=np.int64),
            lengths=np.array([len(film.frames) for film in films], dtype=np.int64),
        )


def read_films(evaluation: Evaluation) -> list[Film]:
    """Return the films of an evaluation; none if it kept none.

    Raises:
        DamagedError: the file is not as it was written.
    """
    path = evaluation.folder / FILMS_FILE
    if not path.is_file() or not evaluation.names(FILMS_FILE):
        return []
    if not evaluation.has(FILMS_FILE):
        raise DamagedError(f"{path}: damaged, its SHA-256 is not the one in {EVAL_FILE}; {REMEDY}")
    try:
        with np.load(path, allow_pickle=False) as stored:
            frames, episodes, lengths = stored["frames"], stored["episodes"], stored["lengths"]
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise DamagedError(f"{path}: not the films of an evaluation ({error}); {REMEDY}") from None
    rows = {row.episode: row for row in evaluation.rows()}
    ends = np.cumsum(lengths)
    return [
        Film(rows[int(episode)], frames[end - length : end])
        for episode, end, length in zip(episodes, ends, lengths, strict=True)
    ]
