"""A pool that lies on the device gives the very batches that are streamed from the shards."""

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from graspq.common.errors import UserError
from graspq.datasets.dataset import open_shards
from graspq.train.batch import Batch
from graspq.train.batches import batch_items, training_batches
from graspq.train.loop import train
from graspq.train.parallel import ALONE, Ranks
from graspq.train.resident import ResidentPool, image_bytes
from graspq.train.run import Run
from graspq.train.settings import TrainSettings

Make = Callable[..., TrainSettings]
CPU = torch.device("cpu")


def batches(settings: TrainSettings, count: int, start: int = 0, ranks: Ranks = ALONE) -> list[Batch]:
    pool = open_shards(settings.shards)
    with training_batches(pool, settings, CPU, start, ranks) as endless:
        return list(itertools.islice(endless, count))


def assert_same(first: Batch, second: Batch) -> None:
    assert first.more.keys() == second.more.keys() == {"gripper_pose"}
    names = {field.name for field in dataclasses.fields(Batch)} - {"more"}
    ours, theirs = ({name: getattr(batch, name) for name in names} | batch.more for batch in (first, second))
    for name, one in ours.items():
        other = theirs[name]
        if isinstance(one, Tensor):
            assert one.dtype == other.dtype and one.shape == other.shape, name
            assert torch.equal(one, other), name
        else:
            assert one is None and other is None, name


@pytest.mark.parametrize("algo", ["mc", "dql", "corr-mc"])
@pytest.mark.parametrize("ranks", [ALONE, Ranks(1, 3)])
def test_resident_batches_are_those_of_the_stream_bit_by_bit(settings: Make, algo: str, ranks: Ranks) -> None:
    discounted = {"discount": 0.7} if algo == "mc" else {}
    # Beyond the end of an epoch.
    both = (settings(algo, resident=resident, last_step_weight=3, **discounted) for resident in (False, True))
    streamed, resident = (batches(one, 40, 5, ranks) for one in both)
    for first, second in zip(streamed, resident, strict=True):
        assert_same(first, second)
        weight = 1.0 + 2.0 * first.terminal if algo == "corr-mc" else None
        assert first.weight is weight is None or torch.equal(first.weight, weight)
    assert (streamed[0].next_image is not None) == (algo == "dql")


def test_a_resident_run_ends_in_the_same_bits_and_may_go_on_streamed(settings: Make, tmp_path: Path) -> None:
    train(settings("corr-mc", out=tmp_path / "streamed", resident=False))
    train(settings("corr-mc", out=tmp_path / "both", resident=True), stop_at=10)
    train(settings("corr-mc", out=tmp_path / "both", resident=False))
    first, second = (Run.open(tmp_path / name).checkpoint(20) for name in ("streamed", "both"))
    assert (first / "state.json").read_bytes() == (second / "state.json").read_bytes(), "digests of all tensors"


def test_images_that_fit_nowhere_are_refused_in_one_line(dataset: Path) -> None:
    pool = open_shards([dataset])
    first = dataclasses.replace(pool.blocks[0], rows=2**52)
    with pytest.raises(UserError, match=r"--resident: .* GiB of images do not fit on cpu; leave it out"):
        ResidentPool.read(dataclasses.replace(pool, blocks=(first, *pool.blocks[1:])), CPU)


def test_a_mean_follows_the_weights_of_the_real_steps() -> None:
    step = torch.zeros(2, 2, dtype=torch.int64)
    mask, weight = torch.tensor([[True, True], [True, False]]), torch.tensor([[1.0, 3.0], [2.0, 9.0]])
    batch = Batch(*[step.float()] * 7, mask=mask)
    values = torch.tensor([1.0, 2.0, 4.0])
    assert batch.mean(values) == pytest.approx(7 / 3)
    assert dataclasses.replace(batch, weight=weight).mean(values) == pytest.approx((1 + 6 + 8) / 6)


def test_episodes_whose_last_steps_weigh_once_have_the_plain_mean(settings: Make) -> None:
    (batch,) = batches(settings("corr-mc", last_step_weight=1), 1)
    assert batch.weight is None


def test_a_run_of_before_there_was_a_setting_goes_on_without_it(settings: Make) -> None:
    recorded = settings("mc").to_json()
    assert recorded.pop("last_step_weight") != 1 and recorded.pop("color") != 0
    restored = TrainSettings.from_json(recorded)
    assert (restored.last_step_weight, restored.color) == (1, 0)


def test_a_batch_of_episodes_has_about_as_many_transitions_or_so_many_episodes(settings: Make, dataset: Path) -> None:
    pool = open_shards([dataset])
    episodes = batch_items(pool, settings("corr-mc"))
    assert abs(episodes * pool.rows / pool.episodes - 32) < pool.rows / pool.episodes
    assert batch_items(pool, settings("corr-mc", batch_of="episodes")) == 32
    assert batch_items(pool, settings("corr-mc", batch_of="episodes", batch_size=10**6)) == pool.episodes
    assert batch_items(pool, settings("mc")) == 32
    assert image_bytes(pool) == pool.rows * 16 * 16 * 3
