import dataclasses
import itertools
import pickle
import subprocess
import sys

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

import graspq
from graspq.common.errors import UserError
from graspq.datasets.samples import EpisodeBatch


@pytest.fixture(scope="module")
def grasps(many_blocks):
    return graspq.open(many_blocks)


def first(batches, count):
    with batches:
        return list(itertools.islice(batches, count))


def test_importing_graspq_imports_neither_torch_nor_pybullet_nor_arrow(tmp_path):
    code = "import sys, graspq; print({'torch', 'pybullet', 'pyarrow'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=True)
    assert done.stdout.strip() == "set()"


def test_opened_grasps_say_what_they_hold(grasps, drawn, many_blocks):
    assert (len(grasps), grasps.episodes, grasps.image_shape, grasps.discount) == (800, 800, (8, 8, 3), 1.0)
    assert grasps.rows == sum(drawn.episode(index, 4).steps for index in range(800))
    assert (grasps.task["name"], grasps.action.names) == ("regular", ("dx", "dy", "dz", "dphi"))
    assert repr(grasps) == f"<800 grasps of the regular task, {grasps.rows:,} steps, from {many_blocks}>"


@pytest.mark.parametrize("number", [0, 5, 799, -1])
def test_an_episode_by_number_is_the_one_that_was_collected(grasps, drawn, number):
    episode, expected = grasps[number], drawn.episode(number % 800, 4)
    for field in dataclasses.fields(expected):
        assert np.array_equal(getattr(episode, field.name), getattr(expected, field.name)), field.name


def test_episodes_can_be_iterated_and_end(new_dataset):
    grasps = graspq.open(new_dataset(blocks=2))
    assert [episode.episode_id for episode in grasps] == [0, 1, 2, 3]
    with pytest.raises(IndexError, match="episode 4: there are 4"):
        grasps[4]


def test_torch_takes_the_arrays_of_a_batch_without_a_copy(grasps):
    for size, view in itertools.product((1, 16), ("transitions", "episodes")):
        (batch,) = first(grasps.batches(size, view=view), 1)
        tensors = batch.tensors()
        assert set(tensors) >= {"image", "step", "action", "reward", "terminal", "mc_return", "gripper_pose"}
        for name, array in batch.arrays().items():
            assert tensors[name].data_ptr() == array.ctypes.data, name
    assert isinstance(batch, EpisodeBatch) and tensors["mask"].dtype == torch.bool


def test_every_row_and_episode_comes_once_for_validation(grasps):
    assert sum(len(batch) for batch in grasps.once(300)) == grasps.rows
    assert sum(int(batch.mask.sum()) for batch in grasps.once(64, view="episodes")) == grasps.rows


def test_held_back_grasps_share_no_block_with_the_others(grasps):
    training, held_back = grasps.split(0.2, seed=1)
    assert len(training) + len(held_back) == 800
    blocks = [{ref.block for ref in side.blocks} for side in (training, held_back)]
    assert not blocks[0] & blocks[1]
    assert held_back[0].block in blocks[1]


def test_another_discount_is_that_of_the_batches(grasps):
    (batch,) = first(grasps.with_discount(0.0).batches(64), 1)
    assert np.array_equal(batch.mc_return, batch.reward)


@pytest.mark.parametrize("workers", [0, 2])
def test_a_data_loader_of_any_number_of_workers_gives_the_same_batches(grasps, workers):
    expected = first(grasps.batches(64, seed=2, start_step=1), 5)
    dataset = grasps.torch_dataset(64, seed=2, start_step=1)
    loader = DataLoader(
        dataset, batch_size=None, num_workers=workers, multiprocessing_context="fork" if workers else None
    )
    for batch, tensors in zip(expected, loader, strict=False):
        assert torch.equal(tensors["image"], torch.from_numpy(batch.image))
        assert torch.equal(tensors["mc_return"], torch.from_numpy(batch.mc_return))


def test_opened_grasps_can_be_sent_to_another_process(grasps):
    there = pickle.loads(pickle.dumps(grasps))
    assert np.array_equal(there[3].images, grasps[3].images)


def test_a_view_that_there_is_not_is_named(grasps):
    with pytest.raises(UserError, match="view 'steps': expected transitions or episodes"):
        grasps.batches(view="steps")
