import dataclasses
import shutil

import numpy as np
import pytest

from graspq.common.errors import UserError
from graspq.datasets import columns
from graspq.datasets.manifest import Manifest
from graspq.datasets.verify import verify
from graspq.datasets.writer import commit_shard, write_shard

FILES = (
    "manifest.json",
    "README.md",
    "objects/object_set.json",
    "objects/meshes/train_001.obj",
    "shards/blocks-000000-000004.parquet",
    "episodes/blocks-000010-000011.parquet",
)


def faults_of(folder):
    try:
        return verify(folder).faults
    except UserError as error:
        return (error.message,)


def test_an_intact_dataset_has_no_fault_and_every_file_is_checked(dataset):
    seen = []
    report = verify(dataset, seen.append)
    assert (report.faults, report.notes) == ((), ())
    assert report.files == len([path for path in dataset.rglob("*") if path.is_file()]) == 10
    assert sum(seen) == Manifest.load(dataset).bytes


@pytest.mark.parametrize("name", FILES)
def test_a_single_flipped_bit_in_any_file_is_a_fault_that_names_it(new_dataset, name):
    folder = new_dataset()
    path = folder / name
    content = path.read_bytes()
    for position in np.unique(np.linspace(0, len(content) - 1, 15).astype(int)):
        flipped = bytearray(content)
        flipped[position] ^= 1 << int(position) % 8
        path.write_bytes(flipped)
        faults = faults_of(folder)
        assert len(faults) == 1
        assert name in faults[0]
        assert "\n" not in faults[0]


@pytest.mark.parametrize("name", FILES)
def test_a_missing_or_truncated_file_is_a_fault_that_names_it(new_dataset, name):
    folder = new_dataset()
    content = (folder / name).read_bytes()
    (folder / name).write_bytes(content[:-9])
    assert name in faults_of(folder)[0]
    (folder / name).unlink()
    assert name in faults_of(folder)[0]


def test_the_damaged_block_is_named(new_dataset):
    folder = new_dataset()
    path = folder / FILES[4]
    content = bytearray(path.read_bytes())
    content[300] ^= 1
    path.write_bytes(content)
    assert "(block 0)" in faults_of(folder)[0]


def test_files_of_others_are_noted_and_are_no_fault(new_dataset):
    folder = new_dataset()
    shutil.copy(folder / FILES[4], folder / "shards/blocks-000090-000099.parquet")
    (folder / "shards/.tmp-7-x.parquet").write_text("part")
    report = verify(folder)
    assert report.faults == ()
    assert [note.split(": ")[0].removeprefix(f"{folder}/") for note in report.notes] == [
        "shards/.tmp-7-x.parquet",
        "shards/blocks-000090-000099.parquet",
    ]


def test_blocks_that_are_not_there_yet_are_noted(new_dataset):
    folder = new_dataset()
    manifest = Manifest.load(folder)
    dataclasses.replace(manifest, shards=(manifest.shards[0], manifest.shards[2])).save(folder)
    assert any("blocks 5 to 9 are not there" in note for note in verify(folder).notes)


@pytest.mark.parametrize("label", ["mc_return", "synthetic_action"])
def test_a_label_that_is_not_that_of_its_rewards_and_poses_is_a_fault(drawn, tmp_path, monkeypatch, label):
    drawn.dataset(tmp_path, blocks=1)
    right = getattr(columns, label)
    manifest = Manifest.load(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(columns, label, lambda *arguments: right(*arguments) + np.float32(1e-3))
        commit_shard(tmp_path, manifest, write_shard(tmp_path, manifest, 0, 1, drawn.episodes(0, 1)))
    faults = verify(tmp_path).faults
    assert len(faults) == 2
    assert all(label in fault and "block 0: episode" in fault for fault in faults)


def test_a_shard_written_for_another_discount_is_a_fault(drawn, tmp_path):
    drawn.dataset(tmp_path, blocks=1)
    manifest = dataclasses.replace(Manifest.load(tmp_path), discount=0.5)
    manifest.save(tmp_path)
    assert any("metadata" in fault for fault in verify(tmp_path).faults)


def test_counts_that_are_not_those_of_the_files_are_a_fault(new_dataset):
    folder = new_dataset()
    manifest = Manifest.load(folder)
    wrong = dataclasses.replace(manifest.shards[1], successes=manifest.shards[1].successes + 1)
    manifest.with_shard(wrong).save(folder)
    assert len(verify(folder).faults) == 1


def test_workers_find_what_this_process_finds_in_the_order_of_the_shards(new_dataset):
    folder = new_dataset()
    for path in sorted((folder / "shards").iterdir()):
        path.write_bytes(path.read_bytes()[:-1] + b"?")
    seen = []
    assert verify(folder, seen.append, workers=2) == verify(folder) and len(verify(folder).faults) == 3
    assert sum(seen) == Manifest.load(folder).bytes
