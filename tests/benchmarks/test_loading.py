"""Rivals of loading give transitions of the data, and a run of the whole benchmark in its shortest form."""

import itertools

import pytest
import torch

from graspq.benchmarks import loading_rivals
from graspq.benchmarks.loading import PNG, RIVALS, STREAMING, LoadingSettings, check, consume, known, larger, measure
from graspq.benchmarks.loading_rivals import Frames
from graspq.common.errors import UserError

BATCH = 16


@pytest.fixture(autouse=True)
def no_processes(monkeypatch):
    monkeypatch.setattr(loading_rivals, "WORKERS", 0)


@pytest.fixture(scope="module")
def frames(pool):
    return Frames(pool)


@pytest.mark.parametrize("name", RIVALS)
def test_a_rival_gives_transitions_of_the_data(frames, name, tmp_path):
    if name != PNG:
        pytest.importorskip("datasets")
    check(name, RIVALS[name](frames, tmp_path, BATCH), known(frames))


def test_a_rival_that_gives_another_next_picture_is_refused(frames, tmp_path):
    batch = next(iter(RIVALS[PNG](frames, tmp_path, BATCH)()))
    wrong = batch | {"next_image": torch.roll(batch["next_image"], 1, 0)}
    with pytest.raises(UserError, match="not in the data"):
        check("wrong", lambda: [wrong], known(frames))


def test_an_epoch_that_is_too_short_is_refused():
    consume(itertools.count, 5)
    consume(lambda: range(4), 5, slack=1)
    with pytest.raises(UserError, match="ended after 3"):
        consume(lambda: range(3), 5, slack=1)


def test_a_small_pool_is_named_so_often_that_a_tenth_of_it_is_enough(pool):
    wide, buffer_bytes = larger(pool, BATCH)
    assert len(wide.blocks) % len(pool.blocks) == 0
    assert buffer_bytes == wide.rows // 10 * pool.row_bytes
    # Two windows of 64 blocks are the least that the sampler takes.
    assert len(wide.blocks) // 10 >= 2 * 64


def test_ours_is_measured_against_png_files_and_a_rival_that_is_left_out_is_not_measured(shards, monkeypatch):
    for name in set(RIVALS) - {PNG}:
        monkeypatch.delitem(RIVALS, name)
    settings = LoadingSettings(shards=(shards,), batch_size=BATCH, turns=1, rival_batches=2)
    result = measure(settings)
    rows = {row["loader"]: row for row in result.tables["Loading shuffled transitions with s' from disk"]}
    assert len(rows) == 4 and rows[PNG][f"times {PNG}"] == 1.0
    assert all(row["samples a second"] > 0 for row in rows.values())
    assert result.ratios[0].value == rows[STREAMING][f"times {PNG}"]
    assert {ratio.row()[1] for ratio in result.ratios[3:]} == {"not measured"}
