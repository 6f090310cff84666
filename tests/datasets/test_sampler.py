import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspq.common.errors import UserError
from graspq.datasets.sampler import Sampler

ROWS = np.random.default_rng(5).integers(60, 140, 400)
OWNER = np.repeat(np.arange(400), ROWS)


def resident(**options):
    return Sampler(ROWS, 256, 3, 10**9, **options)


def streaming(**options):
    return Sampler(ROWS, 256, 3, 22_000, **options)


@pytest.mark.parametrize("make", [resident, streaming])
def test_an_epoch_visits_every_sample_at_most_once_and_leaves_out_less_than_a_batch(make):
    sampler = make()
    seen = np.concatenate([sampler.global_indices(0, step) for step in range(sampler.steps_per_epoch)])
    assert len(np.unique(seen)) == len(seen)
    assert 0 <= ROWS.sum() - len(seen) < 256


@pytest.mark.parametrize("make", [resident, streaming])
def test_a_batch_of_256_spans_at_least_64_blocks(make):
    sampler = make()
    spans = [len(np.unique(OWNER[sampler.global_indices(1, step)])) for step in range(sampler.steps_per_epoch)]
    assert min(spans) >= 64


def test_a_batch_of_256_spans_all_of_64_equal_blocks():
    sampler = Sampler([110] * 64, 256, 0, 10**9)
    owner = np.repeat(np.arange(64), 110)
    spans = [len(np.unique(owner[sampler.indices(0, step)])) for step in range(sampler.steps_per_epoch)]
    assert min(spans) == 64


@pytest.mark.parametrize("make", [resident, streaming])
def test_the_order_is_a_function_of_seed_epoch_and_step_alone(make):
    used, fresh = make(), make()
    walked = {(e, s): used.indices(e, s) for e in range(2) for s in range(used.steps_per_epoch)}
    for epoch, step in ((1, 40), (0, 3), (1, 0), (0, 100)):
        assert np.array_equal(fresh.indices(epoch, step), walked[epoch, step])


def test_seeds_and_epochs_give_different_orders():
    first = resident().indices(0, 0)
    assert not np.array_equal(first, resident().indices(1, 0))
    assert not np.array_equal(first, Sampler(ROWS, 256, 4, 10**9).indices(0, 0))


@pytest.mark.parametrize("ranks", [1, 2, 3, 4])
def test_the_parts_of_all_ranks_put_together_are_the_global_batch(ranks):
    whole = streaming()
    parts = [streaming(rank=rank, ranks=ranks) for rank in range(ranks)]
    for global_step in (0, 37, whole.steps_per_epoch - 1, whole.steps_per_epoch + 2):
        epoch, step = whole.position(global_step)
        joined = np.concatenate([part.indices(epoch, step) for part in parts])
        assert np.array_equal(joined, whole.indices(epoch, step))


def test_positions_count_over_epochs():
    sampler = resident()
    assert sampler.position(0) == (0, 0)
    assert sampler.position(2 * sampler.steps_per_epoch + 5) == (2, 5)


def test_two_windows_in_a_row_fit_the_buffer_in_every_epoch():
    sampler = streaming()
    assert sampler.windows_per_epoch > 1
    for epoch in range(5):
        rows = [ROWS[window].sum() for window in sampler.windows(epoch)]
        counts = [len(window) for window in sampler.windows(epoch)]
        assert max(rows) <= 11_000
        assert max(counts) - min(counts) <= 1
        assert min(counts) >= 64
        assert np.array_equal(np.sort(np.concatenate(sampler.windows(epoch))), np.arange(400))


def test_a_batch_takes_from_the_windows_that_windows_of_names():
    sampler = streaming()
    for step in range(sampler.steps_per_epoch):
        windows = sampler.windows(0)
        touched = sampler.windows_of(0, step)
        allowed = np.concatenate([windows[index] for index in touched])
        owners = OWNER[sampler.global_indices(0, step)]
        assert set(owners) <= set(allowed)
        assert len(touched) <= 2


def test_every_row_of_a_block_is_equally_likely_to_come_first():
    counts = np.zeros(4)
    for seed in range(2000):
        order = np.concatenate([Sampler([4, 4], 8, seed, 10**9).indices(0, 0)])
        counts[next(item for item in order if item < 4)] += 1
    assert counts.min() > 420
    assert counts.max() < 580


def test_items_other_than_rows_are_numbered_by_their_own_counts():
    sampler = Sampler(ROWS, 32, 0, 22_000, items_per_block=[20] * 400)
    seen = np.concatenate([sampler.indices(0, step) for step in range(sampler.steps_per_epoch)])
    assert sampler.steps_per_epoch == 250
    assert np.array_equal(np.sort(seen), np.arange(8000))


def test_a_buffer_too_small_to_mix_blocks_names_what_is_enough():
    with pytest.raises(UserError, match=r"--buffer-bytes.*mix 64 blocks.*give room for (\d+) rows") as caught:
        Sampler(ROWS, 256, 0, 3000)
    enough = int(caught.value.message.split("give room for ")[1].split()[0])
    Sampler(ROWS, 256, 0, enough)


@pytest.mark.parametrize("batch_size", [0, -1, 10**6])
def test_a_batch_larger_than_the_data_or_empty_is_refused(batch_size):
    with pytest.raises(UserError, match=r"^batch_size: expected 1 to"):
        Sampler(ROWS, batch_size, 0, 10**9)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.integers(1, 30), min_size=1, max_size=200),
    st.integers(1, 64),
    st.integers(100, 5000),
    st.integers(0, 2**40),
)
def test_whatever_the_blocks_an_epoch_is_a_permutation_within_bounds(rows, batch_size, buffer_rows, seed):
    try:
        sampler = Sampler(rows, batch_size, seed, buffer_rows)
    except UserError:
        return
    seen = np.concatenate([sampler.indices(0, step) for step in range(sampler.steps_per_epoch)])
    assert len(np.unique(seen)) == len(seen) == sum(rows) // batch_size * batch_size
    assert seen.min() >= 0
    assert seen.max() < sum(rows)
    windows = [np.asarray(rows)[window].sum() for window in sampler.windows(0)]
    assert len(windows) == 1 or max(windows) <= buffer_rows // 2
