"""Films: which episodes are kept does not depend on the order in which they end, and frames survive the disk."""

from pathlib import Path

import numpy as np
import pytest

from graspq.evaluate.films import Film, FilmKeeper, read_films, write_films
from graspq.evaluate.records import EpisodeRow, write_rows, write_summary


def row_of(episode: int, success: bool) -> EpisodeRow:
    lifted = "test_000" if success else None
    return EpisodeRow(episode, 0, ("test_000",), success, lifted, 2, "height", float(success), None)


def frames_of(episode: int, count: int = 3) -> list[np.ndarray]:
    return [np.full((8, 8, 3), 10 * episode + step, dtype=np.uint8) for step in range(count)]


def film_of(episode: int, success: bool) -> Film:
    return Film(row_of(episode, success), np.stack(frames_of(episode)))


@pytest.mark.parametrize(
    ("successes", "expected"),
    [
        ({1, 4, 5, 8}, [0, 1, 2, 4]),
        ({9}, [0, 1, 2, 9]),
        (set(), [0, 1, 2, 3]),
        (set(range(10)), [0, 1, 2, 3]),
    ],
)
def test_the_first_of_both_kinds_are_kept_in_whatever_order_they_end(successes: set[int], expected: list[int]) -> None:
    for seed in range(5):
        keeper = FilmKeeper(4)
        for episode in np.random.default_rng(seed).permutation(10).tolist():
            keeper.offer(film_of(episode, episode in successes))
        assert [film.row.episode for film in keeper.chosen()] == expected


def test_no_films_are_kept_when_none_are_wanted() -> None:
    keeper = FilmKeeper(0)
    keeper.offer(film_of(0, True))
    assert keeper.chosen() == []


def test_films_come_back_from_disk_pixel_by_pixel(tmp_path: Path) -> None:
    films = [Film(row_of(2, True), np.stack(frames_of(2))), Film(row_of(7, False), np.stack(frames_of(7, 5)))]
    write_rows(tmp_path, [film.row for film in films])
    write_films(tmp_path, films)
    evaluation = write_summary(tmp_path, {"format_version": 1})
    back = read_films(evaluation)
    assert [film.row for film in back] == [film.row for film in films]
    assert all(np.array_equal(one.frames, two.frames) for one, two in zip(back, films, strict=True))
    write_films(tmp_path, [])
    assert read_films(write_summary(tmp_path, {"format_version": 1})) == []
