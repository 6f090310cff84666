import itertools

import click
import pytest
import torch
from loading import check, consume, known
from loading_rivals import Table, _Pairs, hugging_face_map, hugging_face_stream, lerobot_style, png_files
from streaming import larger

BATCH = 16


@pytest.fixture(scope="module")
def data(pool):
    return Table(pool)


@pytest.fixture(scope="module")
def transitions(data):
    return known(data)


def test_png_files_give_transitions_of_the_data(data, transitions, tmp_path):
    check("png", png_files(data, tmp_path, BATCH, 0), transitions)


def test_hugging_faces_and_lerobots_ways_give_transitions_of_the_data(pool, data, transitions, tmp_path):
    pytest.importorskip("datasets")
    check("map", hugging_face_map(pool, tmp_path / "arrow", BATCH, 0), transitions)
    check("stream", hugging_face_stream(pool, BATCH, 0), transitions)
    check("lerobot", lerobot_style(data, tmp_path / "lerobot", BATCH, 0), transitions)


def test_a_streamed_epoch_of_hugging_face_holds_every_transition_but_the_last(pool):
    pytest.importorskip("datasets")
    batches = list(hugging_face_stream(pool, 1, 0)())
    assert len(batches) == pool.rows - 1


def test_a_rival_that_gives_another_next_picture_is_refused(data, transitions, tmp_path):
    batch = next(iter(png_files(data, tmp_path, BATCH, 0)()))
    wrong = batch | {"next_image": torch.roll(batch["next_image"], 1, 0)}
    with pytest.raises(click.ClickException, match="not in the data"):
        check("wrong", lambda: [wrong], transitions)


def test_an_epoch_that_is_too_short_is_refused():
    consume(itertools.count(), 5)
    consume(range(4), 5, slack=1)
    with pytest.raises(click.ClickException, match="ended after 3"):
        consume(range(3), 5, slack=1)


def test_a_small_pool_is_named_so_often_that_a_tenth_of_it_is_enough(pool):
    wide, buffer_bytes = larger(pool, BATCH)
    assert len(wide.blocks) % len(pool.blocks) == 0
    assert buffer_bytes == wide.rows // 10 * pool.row_bytes
    # Two windows of 64 blocks are the least that the sampler takes.
    assert len(wide.blocks) // 10 >= 2 * 64


def rows(*numbers):
    """Return rows of a stream of episodes of three steps."""
    return {"image": list(numbers), "step": [n % 3 for n in numbers], "terminal": [n % 3 == 2 for n in numbers]}


def test_streamed_rows_become_transitions_across_batches_and_what_a_row_does_not_continue_is_left_out():
    pairs = _Pairs()
    made = [pairs(rows(*range(4))), pairs(rows(*range(4, 9)))]
    found = [pair for one in made for pair in zip(one["image"], one["next_image"], strict=True)]
    assert found == [(n, n if n % 3 == 2 else n + 1) for n in range(8)]
    # The stream begins anew: row 8, held back, ends an episode; then row 1, held back, is not continued by row 0.
    again, broken = pairs(rows(0, 1)), pairs(rows(0, 1, 2))
    assert [again["image"], again["next_image"]] == [[8, 0], [8, 1]]
    assert [broken["image"], broken["next_image"]] == [[0, 1], [1, 2]]
