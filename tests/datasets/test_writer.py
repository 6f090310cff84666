import dataclasses
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from graspq.common.errors import MachineError, UserError
from graspq.common.files import sha256_of
from graspq.datasets.dataset import Shard, open_shards
from graspq.datasets.images import decoded
from graspq.datasets.manifest import Manifest
from graspq.datasets.verify import verify
from graspq.datasets.writer import commit_shard, remove_leftovers, write_shard


def files_of(folder):
    return {path.relative_to(folder).as_posix(): sha256_of(path) for path in folder.rglob("*") if path.is_file()}


def test_what_is_read_is_what_was_written(dataset, drawn):
    pool = open_shards([dataset])
    rows = [row for shard in Shard.all_of(dataset) for row in shard.episode_rows()]
    for block, ref in enumerate(pool.blocks):
        arrays = pool.read_block(ref)
        for number in range(2):
            episode = drawn.episode(2 * block + number)
            span = slice(arrays.first_rows[number], arrays.first_rows[number] + arrays.lengths[number])
            assert np.array_equal(arrays.images[span], episode.images)
            assert np.array_equal(arrays.records["action"][span], episode.actions)
            assert np.array_equal(arrays.records["reward"][span], episode.rewards)
            assert np.array_equal(arrays.records["gripper_pose"][span], episode.gripper_poses)
            assert arrays.records["terminal"][span].tolist() == [False] * (episode.steps - 1) + [True]
            row = rows[episode.episode_id]
            for name in ("episode_id", "block", "seed", "steps", "ended_by", "success", "lifted_object", "exploration"):
                assert row[name] == getattr(episode, name)
            assert tuple(row["object_ids"]) == episode.object_ids
            assert np.array_equal(np.float32(row["object_poses"]), episode.object_poses)
            assert np.array_equal(np.float32(row["final_pose"]), episode.final_pose)
            assert np.array_equal(decoded(row["final_image"], (8, 8, 3)), episode.final_image)


def test_the_same_episodes_give_the_same_bytes(new_dataset):
    assert files_of(new_dataset("one")) == files_of(new_dataset("two"))


def test_an_extended_dataset_equals_one_made_at_once(drawn, tmp_path):
    description = drawn.manifest()
    short, long = tmp_path / "short", tmp_path / "long"
    manifest = commit_shard(short, description, write_shard(short, description, 0, 2, drawn.episodes(0, 2)[:3]))
    assert [path.name for path in (short / "shards").iterdir()] == ["blocks-000000-000001-short-3.parquet"]
    for blocks in (2, 4):
        entry = write_shard(short, manifest, 0, blocks, drawn.episodes(0, blocks))
        manifest = commit_shard(short, manifest, entry)
    commit_shard(long, description, write_shard(long, description, 0, 4, drawn.episodes(0, 4)))
    assert files_of(short) == files_of(long)


def test_a_shard_exists_only_once_it_is_committed(drawn, tmp_path):
    manifest = drawn.manifest()
    manifest.save(tmp_path)
    write_shard(tmp_path, manifest, 0, 2, drawn.episodes(0, 2))
    assert Manifest.load(tmp_path).shards == ()
    with pytest.raises(UserError, match="no finished shard yet"):
        open_shards([tmp_path])


def test_episodes_that_are_not_those_of_the_blocks_are_refused(drawn, tmp_path):
    manifest, episodes = drawn.manifest(), drawn.episodes(0, 3)
    bad = {
        "blocks": (0, 4, episodes),
        "in order": (0, 3, episodes[::-1]),
        "in each block": (0, 3, episodes[:1] + episodes[2:]),
        "consecutive": (0, 3, [*episodes[:-1], dataclasses.replace(episodes[-1], episode_id=9)]),
        "images": (0, 1, drawn.episodes(0, 1, size=16)),
    }
    for message, (first, blocks, given) in bad.items():
        with pytest.raises(ValueError, match=message):
            write_shard(tmp_path, manifest, first, blocks, given)
    assert list(tmp_path.iterdir()) == []


def test_an_episode_of_format_2_needs_its_final_image(drawn, tmp_path):
    episodes = [dataclasses.replace(episode, final_image=None) for episode in drawn.episodes(0, 1)]
    with pytest.raises(ValueError, match="final_image: expected one in every episode"):
        write_shard(tmp_path, drawn.manifest(), 0, 1, episodes)


def test_a_full_disk_gives_one_line_with_folder_and_bytes_and_leaves_nothing(drawn, tmp_path):
    (tmp_path / "shards").mkdir()
    # Every write to /dev/full fails with ENOSPC: the real error, without a full disk.
    (tmp_path / f"shards/.tmp-{socket.gethostname()}-{os.getpid()}-blocks-000000-000001.parquet").symlink_to(
        "/dev/full"
    )
    with pytest.raises(MachineError, match=r"disk is full; this shard needs [\d,]{4,} bytes") as caught:
        write_shard(tmp_path, drawn.manifest(), 0, 2, drawn.episodes(0, 2))
    assert str(tmp_path) in caught.value.message
    assert files_of(tmp_path) == {}
    assert list((tmp_path / "shards").iterdir()) == []


WRITER = """
import importlib.util, sys
from pathlib import Path
spec = importlib.util.spec_from_file_location("helpers", sys.argv[1])
helpers = importlib.util.module_from_spec(spec)
spec.loader.exec_module(helpers)
from graspq.datasets.images import decoded
from graspq.datasets.manifest import Manifest
from graspq.datasets.writer import commit_shard, remove_leftovers, write_shard
folder = Path(sys.argv[2])
remove_leftovers(folder)
manifest = Manifest.load(folder)
print("ready", flush=True)
for first in range(0, 400, 4):
    if first not in {entry.first_block for entry in manifest.shards}:
        entry = write_shard(folder, manifest, first, 4, helpers.make_episodes(first, 4))
        manifest = commit_shard(folder, manifest, entry)
        print("committed", flush=True)
"""


def test_a_shard_that_was_replaced_is_removed_by_the_next_start_if_its_writer_was_killed_before(drawn, tmp_path):
    manifest = drawn.manifest()
    short = write_shard(tmp_path, manifest, 0, 1, drawn.episodes(0, 1)[:-1])
    manifest = commit_shard(tmp_path, manifest, short)
    kept = {path: (tmp_path / path).read_bytes() for path in short.files}
    manifest = commit_shard(tmp_path, manifest, write_shard(tmp_path, manifest, 0, 2, drawn.episodes(0, 2)))
    for path, content in kept.items():
        (tmp_path / path).write_bytes(content)
    (tmp_path / "shards" / "mine.parquet").write_bytes(b"")
    remove_leftovers(tmp_path)
    left = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.parquet")}
    assert left == {*manifest.shards[0].files, "shards/mine.parquet"}


def test_a_writer_killed_at_any_moment_leaves_a_valid_dataset_that_can_go_on(drawn, tmp_path):
    folder = tmp_path / "killed"
    folder.mkdir()
    helpers = str(Path(__file__).with_name("drawn_data.py"))
    drawn.manifest().save(folder)
    for shards, delay in ((1, 0.0), (2, 0.003), (3, 0.007)):
        arguments = [sys.executable, "-c", WRITER, helpers, str(folder)]
        process = subprocess.Popen(arguments, stdout=subprocess.PIPE, cwd=tmp_path)
        assert process.stdout is not None
        lines = [process.stdout.readline() for _ in range(shards + 1)]
        assert lines == [b"ready\n"] + [b"committed\n"] * shards
        time.sleep(delay)
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
        listed = Manifest.load(folder)
        faults = [fault for fault in verify(folder).faults if "object_set" not in fault]
        assert faults == []
    remove_leftovers(folder)
    assert not list(folder.rglob(".tmp-*"))
    assert 6 <= len(listed.shards) < 100
    whole = tmp_path / "unbroken"
    manifest = drawn.manifest()
    for entry in listed.shards:
        written = write_shard(whole, manifest, entry.first_block, 4, drawn.episodes(entry.first_block, 4))
        assert written == entry


def test_leftovers_are_removed_and_nothing_else(new_dataset):
    folder = new_dataset()
    before = files_of(folder)
    for path in (".tmp-1-manifest.json", "shards/.tmp-2-x.parquet", "episodes/.tmp-3-y.parquet"):
        (folder / path).write_text("part")
    (folder / "shards/notes.txt").write_text("mine")
    remove_leftovers(folder)
    assert set(files_of(folder)) - set(before) == {"shards/notes.txt"}
