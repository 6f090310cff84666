import collections
import gc
import itertools
import multiprocessing
import threading

import numpy as np
import pytest

from graspq.common.errors import UserError
from graspq.datasets.dataset import open_shards
from graspq.datasets.samples import EpisodeBatch, TransitionBatch

SHAPE = (8, 8, 3)


@pytest.fixture(scope="module")
def pool(many_blocks):
    return open_shards([many_blocks])


@pytest.fixture(scope="module")
def small_buffer(pool):
    """Room for a little less than the pool, so that it streams in windows, of which one is read ahead."""
    return int(pool.rows * pool.row_bytes * 0.99)


def take(loader, count):
    with loader:
        return list(itertools.islice(loader, count))


def same(one, two):
    for name in one.__dataclass_fields__:
        assert np.array_equal(getattr(one, name), getattr(two, name)), name


def test_every_transition_is_the_one_that_was_collected(pool, drawn):
    with pool.batches(64, 0) as loader:
        batch = next(loader)
    assert isinstance(batch, TransitionBatch)
    episodes = {index: drawn.episode(index, 4) for index in np.unique(batch.episode_id)}
    for index in range(64):
        episode, step = episodes[batch.episode_id[index]], batch.step[index]
        last = step == episode.steps - 1
        assert batch.terminal[index] == last
        assert np.array_equal(batch.image[index], episode.images[step])
        assert np.array_equal(batch.next_image[index], episode.images[step if last else step + 1])
        assert batch.next_step[index] == (step if last else step + 1)
        assert np.array_equal(batch.action[index], episode.actions[step])
        assert batch.reward[index] == episode.rewards[step]
        assert batch.mc_return[index] == episode.rewards[-1]
        expected = (episode.final_pose - episode.gripper_poses[step]) / np.array(drawn.limits)
        np.testing.assert_allclose(batch.synthetic_action[index], expected, rtol=1e-5, atol=1e-5)
        assert batch.block[index] == episode.block


def test_batches_have_the_stated_types(pool):
    with pool.batches(16, 0) as loader:
        batch = next(loader)
    kinds = {name: str(array.dtype) for name, array in batch.arrays().items()}
    assert {kinds[name] for name in ("image", "next_image")} == {"uint8"}
    assert {kinds[name] for name in ("step", "next_step", "episode_id", "block")} == {"int64"}
    assert {kinds[name] for name in ("action", "reward", "gripper_pose", "mc_return", "synthetic_action")} == {
        "float32"
    }
    assert kinds["terminal"] == "bool"
    assert all(getattr(batch, name).flags.c_contiguous and getattr(batch, name).flags.writeable for name in kinds)


def test_an_epoch_covers_the_data_once(pool):
    loader = pool.batches(100, 0)
    batches = take(loader, loader.sampler.steps_per_epoch)
    keys = {key for batch in batches for key in zip(batch.episode_id.tolist(), batch.step.tolist(), strict=True)}
    assert len(keys) == 100 * len(batches)
    assert pool.rows - len(keys) < 100


def test_an_epoch_takes_last_steps_as_often_as_they_weigh(pool, small_buffer):
    loader = pool.batches(1, 0, buffer_bytes=small_buffer, last_step_weight=3)
    assert loader.sampler.windows_per_epoch > 1
    batches = take(loader, loader.sampler.steps_per_epoch)
    taken = collections.Counter((int(batch.episode_id[0]), int(batch.step[0])) for batch in batches)
    ends = {(int(batch.episode_id[0]), int(batch.step[0])) for batch in batches if batch.terminal[0]}
    assert len(taken) == pool.rows and len(ends) == pool.episodes
    assert all(count == (3 if key in ends else 1) for key, count in taken.items())


@pytest.mark.parametrize("start", [1, 60])
def test_a_resumed_run_gives_the_batches_of_an_unbroken_one(pool, small_buffer, start):
    options = {"buffer_bytes": small_buffer, "last_step_weight": 2}
    unbroken = take(pool.batches(100, 9, **options), 70)
    resumed = take(pool.batches(100, 9, **options, start_step=start), 70 - start)
    for one, two in zip(unbroken[start:], resumed, strict=True):
        same(one, two)


def test_the_background_thread_changes_nothing(pool, small_buffer):
    batches = [take(pool.batches(100, 2, buffer_bytes=small_buffer, prefetch=prefetch), 40) for prefetch in (0, 1, 4)]
    for one, two, three in zip(*batches, strict=True):
        same(one, two)
        same(one, three)


@pytest.mark.parametrize("ranks", [1, 2, 3, 4])
def test_ranks_together_see_the_global_batches(dataset, ranks):
    pool = open_shards([dataset])
    whole = take(pool.batches(22, 1), 5)
    parts = [take(pool.batches(22, 1, rank=rank, ranks=ranks), 5) for rank in range(ranks)]
    for step, batch in enumerate(whole):
        joined = np.concatenate([part[step].image for part in parts])
        assert np.array_equal(joined, batch.image)


def test_data_larger_than_the_buffer_stream_within_it(pool, small_buffer):
    loader = pool.batches(100, 0, buffer_bytes=small_buffer)
    assert loader.sampler.windows_per_epoch > 1
    steps = 2 * loader.sampler.steps_per_epoch + 3
    with loader:
        images = sum(len(batch) for batch in itertools.islice(loader, steps))
    assert images == 100 * steps
    assert loader.peak_bytes <= small_buffer


def test_data_that_fit_are_read_once(pool, monkeypatch):
    reads = []
    read = type(pool).read_block
    monkeypatch.setattr(type(pool), "read_block", lambda self, ref: reads.append(ref.block) or read(self, ref))
    loader = pool.batches(100, 0, prefetch=0)
    take(loader, 3 * loader.sampler.steps_per_epoch)
    assert sorted(reads) == list(range(200))


def test_reading_ahead_leaves_no_window_to_be_read_at_its_border(pool, small_buffer, monkeypatch):
    reads = []
    read = type(pool).read_block
    monkeypatch.setattr(type(pool), "read_block", lambda self, ref: reads.append(ref.block) or read(self, ref))
    loader = pool.batches(100, 0, buffer_bytes=small_buffer, prefetch=0)
    next(loader)
    most = 0
    for _ in range(2 * loader.sampler.steps_per_epoch):
        reads.clear()
        next(loader)
        most = max(most, len(reads))
    assert 0 < most <= 25


def test_without_next_there_is_no_next_image(pool):
    with pool.batches(16, 0, need_next=False) as loader:
        assert next(loader).next_image is None


def test_episodes_are_padded_and_masked(pool, drawn):
    with pool.batches(16, 0, view="episodes") as loader:
        for _ in range(20):  # memory is used again: padding must be written
            batch = next(loader)
    assert isinstance(batch, EpisodeBatch)
    assert batch.image.shape == (16, 15, *SHAPE)
    for index in range(16):
        episode = drawn.episode(batch.episode_id[index, 0], 4)
        steps = episode.steps
        assert batch.mask[index].tolist() == [True] * steps + [False] * (15 - steps)
        assert np.array_equal(batch.image[index, :steps], episode.images)
        assert not batch.image[index, steps:].any()
        assert np.array_equal(batch.action[index, :steps], episode.actions)
        assert batch.terminal[index].nonzero()[0].tolist() == [steps - 1]
        assert batch.step[index].tolist() == list(range(15))
        assert (batch.episode_id[index] == episode.episode_id).all()


def test_an_epoch_of_episodes_covers_them_once_and_resumes(pool):
    loader = pool.batches(50, 4, view="episodes")
    batches = take(loader, loader.sampler.steps_per_epoch)
    assert np.array_equal(np.sort(np.concatenate([batch.episode_id[:, 0] for batch in batches])), np.arange(800))
    same(take(pool.batches(50, 4, start_step=7, view="episodes"), 1)[0], batches[7])


def test_an_episode_longer_than_the_padding_is_refused(pool):
    with pytest.raises(ValueError, match="max_steps"), pool.batches(50, 4, max_steps=3, view="episodes") as loader:
        next(loader)


def test_in_order_every_row_and_episode_comes_once(pool):
    rows = list(pool.once(300))
    assert sum(len(batch) for batch in rows) == pool.rows
    ids = np.concatenate([batch.episode_id for batch in rows])
    assert np.array_equal(ids, np.sort(ids))
    assert sum(int(batch.mask.sum()) for batch in pool.once(64, view="episodes")) == pool.rows


def test_a_shard_damaged_while_training_stops_the_loader_with_one_line(new_dataset):
    folder = new_dataset(blocks=4, per_shard=4)
    pool = open_shards([folder])
    path = pool.blocks[0].path
    content = bytearray(path.read_bytes())
    content[400] ^= 1
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"blocks-000000-000003\.parquet: block \d cannot be read.*grasp-data verify"):
        take(pool.batches(4, 0), 2)


def test_closing_ends_the_thread_and_the_iteration(pool):
    loader = pool.batches(100, 0)
    next(loader)
    loader.close()
    loader.close()
    assert loader_threads() == []
    assert list(loader) == []


def loader_threads():
    return [thread for thread in threading.enumerate() if thread.name == "graspq-loader" and thread.is_alive()]


def test_the_thread_starts_with_the_first_batch_and_ends_when_the_loader_is_dropped(pool):
    loader = pool.batches(100, 0)
    assert loader_threads() == []
    next(loader)
    (thread,) = loader_threads()
    del loader
    gc.collect()
    thread.join(timeout=5)
    assert not thread.is_alive()


def in_a_fork(work):
    """Return what `work` returns, or the error it raises as text, in a fork of this process."""

    def told(sending):
        try:
            sending.send(work())
        except Exception as error:
            sending.send(repr(error))

    receiving, sending = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("fork").Process(target=told, args=(sending,))
    process.start()
    try:
        assert receiving.poll(20), "the fork hangs"
        return receiving.recv()
    finally:
        process.kill()
        process.join()


@pytest.mark.filterwarnings("ignore:.*use of fork.*:DeprecationWarning")
@pytest.mark.parametrize("prefetch", [0, 2])
def test_a_fork_can_begin_a_loader_but_not_go_on_with_one(pool, prefetch):
    with pool.batches(100, 0, prefetch=prefetch) as loader:
        forked = in_a_fork(lambda: next(loader).episode_id)
        assert np.array_equal(forked, next(loader).episode_id)
        told = in_a_fork(lambda: next(loader).episode_id)
        assert "RuntimeError" in told and "make the loader in the process that iterates it" in told
        next(loader)


def test_the_step_counts_the_batches_given_out(pool):
    with pool.batches(100, 0, start_step=5) as loader:
        next(loader)
        next(loader)
        assert loader.step == 7
