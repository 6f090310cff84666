from graspq.common.action_space import grasping
from graspq.datagen.settings import CollectionSettings, DatagenSettings
from graspq.datagen.shards import episodes_of, missing_shards, plan_shards
from graspq.datasets.manifest import Manifest

SETTINGS = CollectionSettings(block_size=20, blocks_per_shard=5)


def empty_manifest():
    return Manifest(
        task={"name": "regular", "max_steps": 15}, settings=SETTINGS.described(), versions={},
        object_set={"name": "drawn", "sha256": "0" * 64}, image_shape=(64, 64, 3),
        action=grasping((0.06, 0.06, 0.06, 0.4)), discount=1.0, phi_range=(-1.75, 1.75),
    )  # fmt: skip


def test_a_larger_dataset_begins_with_the_same_shards():
    small, large = plan_shards(SETTINGS, 200), plan_shards(SETTINGS, 1000)
    assert large[:2] == small
    assert episodes_of(large) == 1000
    assert [block.number for shard in large for block in shard] == list(range(50))


def test_a_size_that_twenty_does_not_divide_ends_in_a_short_block():
    plan = plan_shards(SETTINGS, 130)
    assert [(block.episodes, block.first_episode) for block in plan[-1]] == [(20, 100), (10, 120)]
    assert episodes_of(plan) == 130


def test_all_shards_of_an_empty_dataset_are_missing():
    assert missing_shards(plan_shards(SETTINGS, 130), empty_manifest()) == plan_shards(SETTINGS, 130)


def test_folders_are_named_after_task_and_size():
    assert str(DatagenSettings(size=10_000).folder()) == "data/regular-10k"
    assert str(DatagenSettings(size=1_000_000, task="targeted").folder()) == "data/targeted-1M"
    assert str(DatagenSettings(size=2500).folder()) == "data/regular-2500"
