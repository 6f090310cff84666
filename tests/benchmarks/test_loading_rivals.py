"""Hugging Face's stream of rows as transitions."""

import pytest

from graspq.benchmarks import loading_rivals
from graspq.benchmarks.loading_rivals import Frames, Pairs, hugging_face_stream


def rows(*numbers):
    """Return rows of a stream of episodes of three steps."""
    return {"image": list(numbers), "step": [n % 3 for n in numbers], "terminal": [n % 3 == 2 for n in numbers]}


def test_streamed_rows_become_transitions_across_batches_and_what_a_row_does_not_continue_is_left_out():
    pairs = Pairs()
    made = [pairs(rows(*range(4))), pairs(rows(*range(4, 9)))]
    found = [pair for one in made for pair in zip(one["image"], one["next_image"], strict=True)]
    assert found == [(n, n if n % 3 == 2 else n + 1) for n in range(8)]
    # The stream begins anew: row 8, held back, ends an episode; then row 1, held back, is not continued by row 0.
    again, broken = pairs(rows(0, 1)), pairs(rows(0, 1, 2))
    assert [again["image"], again["next_image"]] == [[8, 0], [8, 1]]
    assert [broken["image"], broken["next_image"]] == [[0, 1], [1, 2]]


def test_a_streamed_epoch_of_hugging_face_holds_every_transition_but_the_last(pool, tmp_path, monkeypatch):
    pytest.importorskip("datasets")
    monkeypatch.setattr(loading_rivals, "WORKERS", 0)
    assert len(list(hugging_face_stream(Frames(pool), tmp_path, 1)())) == pool.rows - 1
