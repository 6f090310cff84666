import numpy as np
import pytest

from graspq.common.errors import UserError
from graspq.sim.task import TASKS, TaskSettings, draw_objects, rewarded_object, task_settings


def test_a_regular_bin_holds_five_different_objects_of_the_split(regular_objects):
    rng = np.random.default_rng(0)
    for _ in range(20):
        ids = draw_objects(TASKS["regular"], regular_objects, "test", rng)
        assert len(set(ids)) == 5
        assert {regular_objects[object_id].split for object_id in ids} == {"test"}


def test_a_targeted_bin_holds_three_crosses_and_four_fixed_distractors(targeted_objects):
    task, rng = TASKS["targeted"], np.random.default_rng(0)
    train, test, clutter = (draw_objects(task, targeted_objects, s, rng) for s in ("train", "test", "test-clutter"))
    splits = [targeted_objects[object_id].split for object_id in train]
    assert splits == ["target"] * 3 + ["distractor"] * 4
    assert train == test
    assert train[:3] == clutter[:3]
    assert not set(train[3:]) & set(clutter[3:])


def test_lifting_another_object_beside_a_target_still_counts(targeted_objects):
    task = TASKS["targeted"]
    target, other = targeted_objects.ids("target")[0], targeted_objects.ids("distractor")[0]
    assert rewarded_object(task, targeted_objects, (other, target)) == target
    assert rewarded_object(task, targeted_objects, (other,)) is None
    assert rewarded_object(task, targeted_objects, ()) is None


def test_the_settings_survive_json():
    assert TaskSettings.from_json(TASKS["targeted"].to_json()) == TASKS["targeted"]


def test_unknown_names_are_refused_in_one_line(regular_objects):
    with pytest.raises(UserError, match="unknown task 'stacking'; choose from regular, targeted"):
        task_settings("stacking")
    with pytest.raises(UserError, match="the regular task has train, test"):
        draw_objects(TASKS["regular"], regular_objects, "test-clutter", np.random.default_rng(0))
    with pytest.raises(UserError, match="no split 'target'; choose from train, test"):
        draw_objects(TASKS["targeted"], regular_objects, "train", np.random.default_rng(0))
