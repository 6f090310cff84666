from pathlib import Path

import gymnasium
import numpy as np
import pyarrow.parquet as pq
import pytest

import graspq  # noqa: F401  (registers the environments)
from graspq.datagen.cli import main as grasp_datagen
from graspq.datasets.manifest import Manifest
from graspq.evaluate.cli import main as grasp_eval
from graspq.evaluate.records import find_evaluations
from graspq.objects.object_set import ObjectSet
from graspq.sim.task import task_from_json

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def command(main, *words):
    with pytest.raises(SystemExit) as ended:
        main([*map(str, words)], prog_name="command")
    assert ended.value.code == 0


@pytest.fixture(scope="module")
def dataset(regular_objects, tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "light"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(EXAMPLES)
        words = ["--task", "own_task:task", "--size", 45, "--objects", regular_objects.folder, "--workers", 1]
        command(grasp_datagen, *words, "--out", folder)
    return folder


def test_grasps_of_a_task_of_ones_own_follow_its_reward_its_objects_and_its_horizon(dataset):
    manifest, objects = Manifest.load(dataset), ObjectSet.load(dataset / "objects")
    assert manifest.task["name"] == "own_task:task" and manifest.task["heaviest"] == 0.05
    rows = pq.read_table(dataset / "episodes").to_pylist()
    for row in rows:
        masses = [objects[object_id].mass for object_id in row["object_ids"]]
        assert len(set(row["object_ids"])) == 3 and min(masses) <= 0.05
        assert row["steps"] <= 8
        if row["success"]:
            assert objects[row["lifted_object"]].mass <= 0.05
    heavy = [row for row in rows if row["lifted_object"] is not None and not row["success"]]
    assert all(objects[row["lifted_object"]].mass > 0.05 for row in heavy)
    assert any(row["success"] for row in rows)


def test_it_is_rebuilt_from_the_manifest_scored_and_an_environment(dataset, regular_objects, tmp_path, monkeypatch):
    monkeypatch.chdir(EXAMPLES)
    assert task_from_json(Manifest.load(dataset).task).settings.heaviest == 0.05
    words = ["--task", "own_task:task", "--policy", "oracle", "--objects", regular_objects.folder, "--split", "train"]
    command(grasp_eval, *words, "--episodes", 4, "--workers", 1, "--out", tmp_path)
    (evaluation,) = find_evaluations(tmp_path)
    assert evaluation.summary["task"] == "own_task:task" and evaluation.summary["successes"] >= 3
    environment = gymnasium.make("graspq/Grasping-v0", task="own_task:task", objects=regular_objects.folder)
    observation, _ = environment.reset(seed=0)
    assert observation["image"].shape == (64, 64, 3) and environment.observation_space["step"].n == 9
    assert [environment.step(np.zeros(4, np.float32))[2] for _ in range(8)] == [False] * 7 + [True]
    environment.close()
