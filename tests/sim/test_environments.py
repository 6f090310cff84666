import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import graspq  # noqa: F401  (registers the environments)
from graspq.common.errors import UserError

NAMES = {"regular": "graspq/RegularGrasping-v0", "targeted": "graspq/TargetedGrasping-v0"}


@pytest.fixture
def folders(regular_objects, targeted_objects):
    return {"regular": regular_objects.folder, "targeted": targeted_objects.folder}


@pytest.mark.parametrize("task", NAMES)
def test_the_environment_passes_gymnasiums_checks(folders, task):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*human.*")
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        environment = gymnasium.make(NAMES[task], objects=folders[task])
        check_env(environment.unwrapped, skip_render_check=True)
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
    with pytest.raises(UserError, match="the regular task has train, test"):
        gymnasium.make(NAMES["regular"], objects=folders["regular"], split="validation")
