import copy
import pickle
import warnings

import gymnasium
import numpy as np
import pyarrow.parquet as pq
import pytest
from gymnasium.utils.env_checker import check_env

import graspq  # noqa: F401  (registers the environments)
from graspq.common.errors import UserError
from graspq.datasets.images import decoded
from graspq.sim.observation import ARM, STILL

NAMES = {"regular": "graspq/RegularGrasping-v0", "targeted": "graspq/TargetedGrasping-v0"}


@pytest.fixture
def folders(regular_objects, targeted_objects):
    return {"regular": regular_objects.folder, "targeted": targeted_objects.folder}


@pytest.mark.parametrize("task", NAMES)
def test_the_environment_passes_gymnasiums_checks_on_a_machine_without_a_display(folders, task, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        environment = gymnasium.make(NAMES[task], objects=folders[task])
        check_env(environment.unwrapped)
        environment.close()


def test_two_environments_in_one_process_do_not_disturb_each_other(folders):
    alone, first, second = (gymnasium.make(NAMES["regular"], objects=folders["regular"]) for _ in range(3))

    def play(environment, other=None):
        frames = [environment.reset(seed=3)[0]["image"]]
        for action in ([0.5, 0.2, -1, 0.1], [-0.4, 0.9, -1, 0.5], [0, 0, -1, 0]):
            if other is not None:
                other.step(np.array([0.1, 0.1, -0.1, 0.1], dtype=np.float32))
            frames.append(environment.step(np.array(action, dtype=np.float32))[0]["image"])
        return np.stack(frames)

    expected = play(alone)
    second.reset(seed=11)
    np.testing.assert_array_equal(play(first, second), expected)
    for environment in (alone, first, second):
        environment.close()


def test_objects_are_switched_every_twenty_episodes(folders):
    environment = gymnasium.make(NAMES["regular"], objects=folders["regular"]).unwrapped
    environment.reset(seed=0)
    bins = []
    for _ in range(41):
        bins.append(environment.simulation.object_ids)
        environment.reset()
    assert len(set(bins[:20])) == 1
    assert len(set(bins[20:40])) == 1
    assert len({bins[0], bins[20], bins[40]}) == 3
    environment.close()


def test_rendering_gives_a_larger_picture_and_bad_arguments_one_line(folders, monkeypatch):
    environment = gymnasium.make(NAMES["targeted"], objects=folders["targeted"], render_mode="rgb_array")
    environment.reset(seed=0)
    assert environment.render().shape == (256, 256, 3)
    environment.close()
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(UserError, match="needs a display"):
        gymnasium.make(NAMES["regular"], objects=folders["regular"], render_mode="human")
    with pytest.raises(UserError, match="the regular task has train, test, validation"):
        gymnasium.make(NAMES["regular"], objects=folders["regular"], split="mirror")


def test_a_copy_is_an_environment_of_its_own_with_the_same_arguments(folders):
    environment = gymnasium.make(NAMES["targeted"], objects=folders["targeted"], split="test").unwrapped
    expected = environment.reset(seed=3)[0]["image"]
    for other in (copy.deepcopy(environment), pickle.loads(pickle.dumps(environment))):
        assert other.simulation.world.client != environment.simulation.world.client
        assert (other.split, other.task) == ("test", environment.task)
        np.testing.assert_array_equal(other.reset(seed=3)[0]["image"], expected)
        other.close()
    environment.step(np.zeros(4, np.float32))
    environment.close()


@pytest.fixture(scope="module")
def recorded(collect_regular, regular_objects, tmp_path_factory):
    """Four recorded episodes, with their rows of the episodes table and their images [T, H, W, C] and actions."""
    folder = collect_regular(tmp_path_factory.mktemp("data") / "regular", regular_objects, 2, 2)
    rows = pq.read_table(folder / "episodes").to_pylist()
    steps = pq.read_table(folder / "shards").to_pylist()
    return folder, rows, [[step for step in steps if step["episode_id"] == row["episode_id"]] for row in rows]


def test_the_scene_of_a_dataset_is_laid_again_and_the_recorded_actions_lead_to_the_recorded_end(recorded):
    folder, rows, episodes = recorded
    environment = gymnasium.make("graspq/Grasping-v0", objects=folder / "objects")
    for row, steps in zip(rows, episodes, strict=True):
        observation, _ = environment.reset(options={"scene": row})
        for step in steps:
            image = decoded(step["image"], (64, 64, 3))
            # Contacts before the objects came to rest are not recorded: what the gripper moves ends a little elsewhere.
            assert (observation["image"] != image).any(axis=-1).mean() <= (0.05 if observation["step"] else 0)
            observation, reward, terminated, *_ = environment.step(np.array(step["action"], np.float32))
        assert terminated and reward == float(row["success"])
    environment.close()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"bin": 3}, "unknown option 'bin'; expected 'scene'"),
        ({"scene": [1]}, "expected a mapping with object_ids and object_poses"),
        ({"scene": {"object_ids": ["a", "b"], "object_poses": [[0] * 7]}}, r"2 rows of 7 finite .* shape \[1, 7\]"),
        ({"scene": {"object_ids": ["a"], "object_poses": [["x"] * 7]}}, "1 rows of 7 finite numbers"),
        ({"scene": {"object_ids": ["nowhere"], "object_poses": [[0] * 6 + [1]]}}, "no object 'nowhere'"),
    ],
)
def test_options_that_mean_nothing_are_refused_in_one_line(folders, options, said):
    environment = gymnasium.make(NAMES["regular"], objects=folders["regular"]).unwrapped
    with pytest.raises(UserError, match=said):
        environment.reset(options=options)
    environment.close()


def test_a_task_of_ones_own_is_an_environment(folders, tmp_path, monkeypatch):
    (tmp_path / "two_objects.py").write_text(
        "import dataclasses\n"
        "from graspq.sim.task import RegularGrasping\n"
        "regular = RegularGrasping()\n"
        "task = regular.with_settings(dataclasses.replace(regular.settings, objects_per_bin=2, max_steps=3))\n"
    )
    monkeypatch.chdir(tmp_path)
    environment = gymnasium.make("graspq/Grasping-v0", task="two_objects:task", objects=folders["regular"])
    environment.reset(seed=0)
    ends = [environment.step(np.zeros(4, np.float32))[2] for _ in range(3)]
    assert ends == [False, False, True] and len(environment.unwrapped.simulation.object_ids) == 2
    environment.close()


def test_depth_and_mask_come_in_info_on_request_alone(folders):
    plain = gymnasium.make(NAMES["regular"], objects=folders["regular"]).unwrapped
    assert set(plain.reset(seed=1)[1]) == {"gripper_pose"}
    environment = gymnasium.make(NAMES["regular"], objects=folders["regular"], depth_and_mask=True).unwrapped
    check_env(environment)
    _, info = environment.reset(seed=1)
    assert set(info) == {"gripper_pose", "depth", "mask"}
    assert (info["depth"].dtype, info["depth"].shape) == (np.float32, (64, 64))
    assert 0.4 < info["depth"].min() < info["depth"].max() < 1.5, "metres"
    assert set(np.unique(info["mask"])) <= {ARM, STILL, 0, 1, 2, 3, 4}
    assert {ARM, STILL} < set(np.unique(info["mask"]))
    before = info["mask"].copy()
    environment.step(np.array([1, 1, -1, 1], dtype=np.float32))
    np.testing.assert_array_equal(info["mask"], before)
    for other in (plain, environment):
        other.close()
