import dataclasses
import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner

from graspq.datasets import columns
from graspq.datasets.cli import main
from graspq.datasets.columns import EPISODES, STEPS, EpisodeColumn, StepColumn, quantities
from graspq.datasets.dataset import Shard, open_shards
from graspq.datasets.manifest import Manifest
from graspq.datasets.samples import Samples
from graspq.datasets.verify import verify
from graspq.datasets.writer import commit_shard, write_shard


def test_a_column_added_to_the_table_is_in_shards_card_batches_and_checks(drawn, tmp_path, monkeypatch):
    to_go = StepColumn(
        "to_go",
        "float32",
        (),
        "height above the final pose, metres",
        label=lambda steps, episode, manifest: steps["gripper_pose"][:, 2] - np.float32(episode["final_pose"][2]),
    )
    corners = StepColumn("corners", "float32", ("A", 2), "measured", value=lambda e: np.stack([e.actions] * 2, -1))
    dropped = EpisodeColumn("dropped", "bool", (), "whether it fell", value=lambda episode: not episode.success)
    monkeypatch.setattr(columns, "STEPS", (*STEPS, to_go, corners))
    monkeypatch.setattr(columns, "EPISODES", (*EPISODES, dropped))
    drawn.dataset(tmp_path, blocks=3)
    assert verify(tmp_path).faults == ()
    card = (tmp_path / "README.md").read_text()
    assert "| `to_go` | float32 | height above the final pose, metres |" in card and "  - name: to_go" in card
    assert [row["dropped"] for row in Shard.all_of(tmp_path)[0].episode_rows()] == [
        not episode.success for episode in drawn.episodes(0, 3)
    ]
    pool = open_shards([tmp_path])
    with pool.batches(8, 0) as transitions, pool.batches(4, 0, view="episodes") as episodes:
        batch, whole = next(transitions), next(episodes)
    for row in range(8):
        episode = drawn.episode(batch.episode_id[row])
        pose = episode.gripper_poses[batch.step[row]]
        assert batch.more["to_go"][row] == pose[2] - episode.final_pose[2]
    assert np.array_equal(batch.tensors()["corners"][:, :, 1], batch.action)
    assert whole.more["to_go"].shape == whole.reward.shape
    monkeypatch.setattr(
        columns, "STEPS", (*STEPS, dataclasses.replace(to_go, label=lambda *given: np.zeros(1)), corners)
    )
    assert all("to_go is not what its other columns give" in fault for fault in verify(tmp_path).faults)
    assert len(verify(tmp_path).faults) == 6


def test_every_column_of_the_table_has_an_attribute_in_batches():
    named = {field.name for field in dataclasses.fields(Samples)} - {"more", "image"}
    assert set(columns.batch_columns()) == named


def test_a_dataset_of_five_part_actions_is_written_read_and_checked(drawn, tmp_path):
    manifest = drawn.dataset(tmp_path, blocks=6, action=drawn.five_parts)
    assert Manifest.load(tmp_path).action == drawn.five_parts
    assert verify(tmp_path).faults == ()
    schema = pq.read_schema(tmp_path / f"shards/{manifest.shards[0].name}.parquet")
    assert json.loads(schema.field("action").metadata[b"order"]) == ["dx", "dy", "dz", "tilt", "close"]
    assert b"phi_range" not in schema.field("gripper_pose").metadata
    pool = open_shards([tmp_path])
    assert pool.action == drawn.five_parts
    with pool.batches(16, 0) as loader:
        batch = next(loader)
    assert batch.action.shape == batch.synthetic_action.shape == batch.gripper_pose.shape == (16, 5)
    episode = drawn.episode(batch.episode_id[0], parts=5)
    assert np.array_equal(batch.action[0], episode.actions[batch.step[0]])
    card = (tmp_path / "README.md").read_text()
    assert "An action of 1 commands 0.06, 0.06, 0.05 m, 0.3 rad, 0.02 m." in card
    assert "x, y, z (m), angle (rad), width (m) before the action" in card
    for arguments in (["info", str(tmp_path)], ["show", str(tmp_path), "--out", str(tmp_path / "strip.png")]):
        assert CliRunner().invoke(main, arguments).exit_code == 0


def test_actions_of_another_size_than_the_manifest_says_are_refused(drawn, tmp_path):
    with pytest.raises(ValueError, match="actions: expected 5 parts, dx, dy, dz, tilt, close"):
        write_shard(tmp_path, drawn.manifest(action=drawn.five_parts), 0, 1, drawn.episodes(0, 1))


def test_datasets_of_other_actions_are_not_mixed(dataset, drawn, tmp_path):
    action = dataclasses.replace(drawn.manifest().action, mirror=None)
    manifest = dataclasses.replace(Manifest.load(dataset), action=action, shards=())
    commit_shard(tmp_path, manifest, write_shard(tmp_path, manifest, 0, 1, drawn.episodes(0, 1)))
    with pytest.raises(Exception, match="cannot mix action spaces"):
        open_shards([dataset, tmp_path])


def test_quantities_name_each_unit_once():
    assert quantities((0.06, 0.06, 0.4), ("m", "m", "rad")) == "0.06, 0.06 m, 0.4 rad"
    assert quantities(("x", "phi"), ("m", "rad"), "{} ({})") == "x (m), phi (rad)"
