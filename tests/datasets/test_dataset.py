import dataclasses
import shutil

import numpy as np
import pytest

from graspq.common.action_space import grasping
from graspq.common.errors import UserError
from graspq.datasets.dataset import open_shards
from graspq.datasets.labels import mc_return
from graspq.datasets.manifest import Manifest
from graspq.datasets.writer import commit_shard, write_shard

FIRST = "shards/blocks-000000-000004.parquet"


def blocks_of(pool):
    return [ref.block for ref in pool.blocks]


def test_a_pool_names_every_block_with_its_rows_and_episodes(dataset, drawn):
    pool = open_shards([dataset])
    assert blocks_of(pool) == list(range(12))
    assert [ref.rows for ref in pool.blocks] == [sum(e.steps for e in drawn.episodes(b, 1)) for b in range(12)]
    assert (pool.episodes, pool.max_steps, pool.discount) == (24, 15, 1.0)
    assert pool.action.limits == drawn.limits
    assert pool.manifest_digest == Manifest.load(dataset).digest()


def test_a_short_last_block_has_its_own_number_of_episodes(drawn, tmp_path):
    manifest = drawn.manifest(block_size=3)
    episodes = [drawn.episode(index, 3) for index in range(7)]
    commit_shard(tmp_path, manifest, write_shard(tmp_path, manifest, 0, 3, episodes))
    pool = open_shards([tmp_path])
    assert [ref.episodes for ref in pool.blocks] == [3, 3, 1]
    assert len(pool.read_block(pool.blocks[2]).lengths) == 1


def test_a_pool_outlives_the_extension_of_its_dataset(drawn, tmp_path):
    manifest = drawn.manifest(block_size=3)
    manifest = dataclasses.replace(manifest, settings={**manifest.settings, "blocks_per_shard": 3})
    episodes = [drawn.episode(index, 3) for index in range(18)]
    manifest = commit_shard(tmp_path, manifest, write_shard(tmp_path, manifest, 0, 3, episodes[:9]))
    for count in (10, 15):
        manifest = commit_shard(
            tmp_path, manifest, write_shard(tmp_path, manifest, 3, -(-count // 3) - 3, episodes[9:count])
        )
        pool = open_shards([tmp_path])
        last = pool.blocks[-1]
        before = pool.read_block(last)
        manifest = commit_shard(tmp_path, manifest, write_shard(tmp_path, manifest, 3, 3, episodes[9:18]))
        assert not last.path.exists()
        after = pool.read_block(last)
        assert np.array_equal(after.images, before.images) and np.array_equal(after.records, before.records)
        assert np.array_equal(pool.read_columns(last, ("step",))["step"], before.records["step"])
        shutil.rmtree(tmp_path / "shards")
        manifest = dataclasses.replace(manifest, shards=())
        manifest = commit_shard(tmp_path, manifest, write_shard(tmp_path, manifest, 0, 3, episodes[:9]))


def test_a_dataset_that_is_extended_while_it_is_opened_or_verified_is_opened_as_it_is_then(
    drawn, tmp_path, monkeypatch
):
    manifest = drawn.manifest(block_size=3)
    episodes = [drawn.episode(index, 3) for index in range(6)]
    shorter = commit_shard(tmp_path, manifest, write_shard(tmp_path, manifest, 0, 2, episodes[:4]))
    real, extended = Manifest.load, []

    def load(folder):
        found = real(folder)
        if not extended:
            extended.append(commit_shard(tmp_path, manifest, write_shard(tmp_path, manifest, 0, 2, episodes)))
        return found

    monkeypatch.setattr(Manifest, "load", load)
    pool = open_shards([tmp_path])
    assert pool.episodes == 6 and pool.manifest_digest == extended[0].digest() != shorter.digest()


def test_another_discount_makes_the_returns_anew_and_leaves_all_else_as_it_is(dataset, drawn):
    pool = open_shards([dataset])
    halved = pool.with_discount(0.5)
    assert (halved.discount, pool.discount) == (0.5, 1.0) and pool.with_discount(1.0) is pool
    training, _ = halved.split(0.2, 0)
    for ref in training.blocks:
        stored, made = pool.read_block(ref).records, training.read_block(ref).records
        expected = np.concatenate([mc_return(episode.rewards, 0.5) for episode in drawn.episodes(ref.block, 1)])
        assert np.array_equal(made["mc_return"], expected)
        for name in set(stored.dtype.names) - {"mc_return"}:
            assert np.array_equal(made[name], stored[name])
    again = halved.with_discount(1.0)
    assert np.array_equal(again.read_block(again.blocks[0]).records, pool.read_block(pool.blocks[0]).records)


def test_columns_are_read_without_the_others(dataset):
    pool = open_shards([dataset])
    block = pool.read_block(pool.blocks[3])
    columns = pool.read_columns(pool.blocks[3], ("step", "synthetic_action"))
    assert list(columns) == ["step", "synthetic_action"]
    assert np.array_equal(columns["step"], block.records["step"])
    assert np.array_equal(columns["synthetic_action"], block.records["synthetic_action"])
    with pytest.raises(UserError, match="block 3 cannot be read"):
        pool.read_columns(pool.blocks[3], ("pose",))


@pytest.mark.parametrize(
    ("patterns", "blocks"),
    [
        (["."], 12),
        (["shards"], 12),
        ([FIRST], 5),
        (["shards/*.parquet"], 12),
        (["shards/blocks-00000[05]*.parquet"], 10),
        (["shards/*10-*.parquet", FIRST], 7),
        ([FIRST, FIRST, "shards/*.parquet", "."], 12),
    ],
)
def test_folders_files_and_globs_name_shards_and_twice_counts_once(dataset, patterns, blocks):
    assert len(open_shards([f"{dataset}/{pattern}" for pattern in patterns]).blocks) == blocks


def test_relative_names_work(dataset, monkeypatch):
    monkeypatch.chdir(dataset.parent)
    assert len(open_shards(["drawn"]).blocks) == len(open_shards(["dr*"]).blocks) == 12
    monkeypatch.chdir(dataset / "shards")
    assert len(open_shards(["blocks-000000-000004.parquet"]).blocks) == 5


def test_the_order_of_names_does_not_matter(dataset):
    names = sorted(str(path) for path in (dataset / "shards").iterdir())
    one, two = open_shards(names), open_shards(names[::-1])
    assert one.blocks == two.blocks
    assert one.manifest_digest == two.manifest_digest == open_shards([dataset]).manifest_digest


def test_a_copy_of_a_dataset_adds_nothing(dataset, tmp_path):
    shutil.copytree(dataset, tmp_path / "copy")
    assert len(open_shards([dataset, tmp_path / "copy"]).blocks) == 12


def test_part_of_a_dataset_has_another_digest(dataset):
    assert open_shards([dataset / FIRST]).manifest_digest != open_shards([dataset]).manifest_digest


def test_a_block_is_read_without_copying_its_images(dataset):
    pool = open_shards([dataset])
    images = pool.read_block(pool.blocks[0]).images
    assert not images.flags.owndata
    assert not images.flags.writeable


@pytest.mark.parametrize(
    ("what", "change"),
    [
        ("tasks", {"task": {"name": "targeted", "max_steps": 15}}),
        ("task settings", {"task": {"name": "regular", "max_steps": 12}}),
        ("simulator versions", {"task": {"name": "regular", "max_steps": 15, "simulator_version": 2}}),
        ("object sets", {"object_set": {"name": "drawn", "sha256": "1" * 64}}),
        ("collection splits", {"settings": {"seed": 0, "block_size": 2, "split": "test"}}),
        ("action limits", {"action": grasping((0.1, 0.1, 0.1, 0.1))}),
        ("discounts", {"discount": 0.9}),
    ],
)
def test_datasets_that_differ_are_not_mixed(dataset, drawn, tmp_path, what, change):
    manifest = dataclasses.replace(Manifest.load(dataset), shards=(), **change)
    commit_shard(tmp_path, manifest, write_shard(tmp_path, manifest, 0, 1, drawn.episodes(0, 1)))
    with pytest.raises(UserError, match=f"cannot mix {what}: .* has .* has ") as caught:
        open_shards([dataset, tmp_path])
    assert str(dataset) in caught.value.message
    assert str(tmp_path) in caught.value.message


def test_image_sizes_are_not_mixed(dataset, drawn, tmp_path):
    drawn.dataset(tmp_path, blocks=1, size=16)
    with pytest.raises(UserError, match=r"cannot mix image shapes.*8, 8, 3.*16, 16, 3"):
        open_shards([dataset, tmp_path])


def test_names_that_are_no_shards_give_one_line(dataset, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.parquet").write_text("x")
    wrong = {
        str(tmp_path / "nothing"): "no such folder or file",
        str(tmp_path / "*.zip"): "no such folder or file",
        str(tmp_path / "empty"): "not a dataset",
        str(tmp_path / "text.parquet"): "not a dataset",
        str(dataset / "episodes/blocks-000000-000004.parquet"): "does not list",
        str(dataset / "manifest.json"): "not a dataset",
    }
    for name, message in wrong.items():
        with pytest.raises(UserError, match=message) as caught:
            open_shards([name])
        assert "\n" not in caught.value.message
    with pytest.raises(UserError, match=r"^shards: expected"):
        open_shards([])


def test_a_file_that_the_manifest_does_not_list_is_refused(new_dataset):
    folder = new_dataset()
    shutil.copy(folder / FIRST, folder / "shards/blocks-000000-000003.parquet")
    with pytest.raises(UserError, match=r"does not list shards/blocks-000000-000003\.parquet"):
        open_shards([folder / "shards/blocks-000000-000003.parquet"])


@pytest.mark.parametrize("length", [0, 7, 500, -1])
def test_a_truncated_shard_gives_one_line_that_names_it_and_the_remedy(new_dataset, length):
    folder = new_dataset()
    content = (folder / FIRST).read_bytes()
    (folder / FIRST).write_bytes(content[:length])
    for verify in (True, False):
        with pytest.raises(UserError, match=r"blocks-000000-000004\.parquet: truncated.*grasp-data verify") as caught:
            open_shards([folder], verify=verify)
        assert "\n" not in caught.value.message


def test_any_flipped_bit_of_a_shard_is_caught_on_opening(new_dataset):
    folder = new_dataset(blocks=2)
    path = next((folder / "shards").iterdir())
    content = path.read_bytes()
    for position in range(0, len(content), 97):
        flipped = bytearray(content)
        flipped[position] ^= 1 << position % 8
        path.write_bytes(flipped)
        with pytest.raises(UserError, match="damaged"):
            open_shards([folder])


def test_a_missing_shard_is_named(new_dataset):
    folder = new_dataset()
    (folder / FIRST).unlink()
    with pytest.raises(UserError, match=r"blocks-000000-000004\.parquet: listed in the manifest but cannot be opened"):
        open_shards([folder])


def test_held_back_blocks_are_whole_disjoint_and_about_the_fraction(many_blocks):
    pool = open_shards([many_blocks])
    training, held_back = pool.split(0.2, 0)
    assert sorted(blocks_of(training) + blocks_of(held_back)) == list(range(200))
    assert 20 <= len(held_back.blocks) <= 60
    assert blocks_of(pool.split(0.2, 0)[1]) == blocks_of(held_back)
    assert blocks_of(pool.split(0.2, 1)[1]) != blocks_of(held_back)


def test_what_is_held_back_stays_so_when_the_dataset_grows_or_moves(drawn, tmp_path):
    drawn.dataset(tmp_path / "small", blocks=40, per_shard=20)
    drawn.dataset(tmp_path / "large", blocks=80, per_shard=20)
    small, large = (set(blocks_of(open_shards([tmp_path / name]).split(0.25, 3)[1])) for name in ("small", "large"))
    assert small == {block for block in large if block < 40}


def test_each_side_gets_a_block_where_there_are_two(new_dataset):
    pool = open_shards([new_dataset(blocks=2)])
    for seed in range(20):
        for fraction in (0.001, 0.999):
            assert [len(side.blocks) for side in pool.split(fraction, seed)] == [1, 1]
    assert [len(side.blocks) for side in pool.split(0.0, 0)] == [2, 0]


@pytest.mark.parametrize("fraction", [-0.1, 1.0, float("nan")])
def test_a_fraction_outside_its_range_is_refused(dataset, fraction):
    with pytest.raises(UserError, match=r"^fraction: expected a number in \[0, 1\)"):
        open_shards([dataset]).split(fraction, 0)
