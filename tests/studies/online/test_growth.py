from pathlib import Path

import pytest

from graspq.common.errors import UserError
from graspq.datagen.collect import Block
from graspq.datagen.settings import CollectionSettings
from graspq.datasets.dataset import open_shards
from graspq.objects.object_set import ObjectSet
from graspq.policies.exploring import ExploringPolicy
from graspq.policies.of_run import load
from graspq.policies.random import RandomPolicy
from graspq.sim.task import TASKS
from graspq.studies.online.growth import GrowingDataset, collection_settings, round_blocks


def test_fifty_grasps_are_two_whole_blocks_and_half_a_one_with_consecutive_episodes(make_plan, tmp_path: Path) -> None:
    settings = collection_settings(make_plan(tmp_path / "out", grasps=50))
    assert round_blocks(settings, 50, 0) == [Block(0, 20, 0), Block(1, 20, 20), Block(2, 10, 40)]
    assert round_blocks(settings, 50, 3) == [Block(9, 20, 150), Block(10, 20, 170), Block(11, 10, 190)]


def test_scenes_are_those_of_no_dataset_of_the_same_seed_and_differ_between_seeds(make_plan, tmp_path: Path) -> None:
    seeds = [collection_settings(make_plan(tmp_path / "out", seed=seed)).seed for seed in (0, 1)]
    assert len({*seeds, CollectionSettings().seed}) == 3


def test_a_round_is_collected_once_and_is_the_same_from_worker_processes(
    make_plan, tmp_path: Path, base: Path, regular_objects: ObjectSet, start: Path
) -> None:
    pool, files = open_shards([base]), []
    policy = ExploringPolicy(0.3, RandomPolicy(), load(start, 6, device="cpu"))
    for workers in (0, 1):
        plan = make_plan(tmp_path / "out", grasps=3, workers=workers)
        growing = GrowingDataset.open(tmp_path / str(workers), plan, TASKS["regular"], regular_objects, pool)
        entry = growing.collect(0, policy)
        assert growing.collect(0, policy) is entry and entry.episodes == 3
        assert [ref.episodes for ref in growing.blocks_of(1)] == [3]
        files.append(entry.files)
    assert files[0] == files[1]


def test_grasps_that_were_collected_otherwise_are_not_mixed_in(
    make_plan, tmp_path: Path, base: Path, regular_objects: ObjectSet
) -> None:
    pool = open_shards([base])
    GrowingDataset.open(tmp_path / "run", make_plan(tmp_path / "out"), TASKS["regular"], regular_objects, pool)
    with pytest.raises(UserError, match=r"holds grasps made with settings.online.cem_samples = 64, not 32"):
        other = make_plan(tmp_path / "out", cem_samples=32)
        GrowingDataset.open(tmp_path / "run", other, TASKS["regular"], regular_objects, pool)


def test_the_coming_rounds_must_fit_on_the_disk(make_plan, tmp_path: Path, base: Path, regular_objects) -> None:
    plan = make_plan(tmp_path / "out", rounds=10**9)
    with pytest.raises(UserError, match="the disk has"):
        GrowingDataset.open(tmp_path / "run", plan, TASKS["regular"], regular_objects, open_shards([base]))
