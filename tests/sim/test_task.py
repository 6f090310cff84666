import dataclasses

import numpy as np
import pytest

from graspq.common.errors import UserError
from graspq.objects.procedural import make_procedural
from graspq.sim.task import TASKS, RegularGrasping, task_from_json, task_named

OWN = """
import dataclasses
from graspq.sim.task import RegularGrasping, TaskSettings

@dataclasses.dataclass(frozen=True)
class Numbers(TaskSettings):
    heaviest: float = 0.5

@dataclasses.dataclass(frozen=True)
class LightGrasping(RegularGrasping):
    settings: Numbers = Numbers(objects_per_bin=2, max_steps=6)

    def wanted(self, objects, object_id):
        return objects[object_id].mass < self.settings.heaviest

light = LightGrasping()
nothing = 3
"""


@pytest.fixture
def own_module(tmp_path, monkeypatch):
    name = f"task_of_{abs(hash(str(tmp_path)))}"
    (tmp_path / f"{name}.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    return name


def test_a_regular_bin_holds_five_different_objects_of_the_split(regular_objects):
    rng = np.random.default_rng(0)
    for _ in range(20):
        ids = TASKS["regular"].draw(regular_objects, "test", rng)
        assert len(set(ids)) == 5
        assert {regular_objects[object_id].split for object_id in ids} == {"test"}


def test_every_split_of_a_task_fills_a_bin_and_a_set_without_one_says_what_it_has(
    regular_objects, targeted_objects, tmp_path
):
    rng = np.random.default_rng(0)
    for task, objects in ((TASKS["regular"], regular_objects), (TASKS["targeted"], targeted_objects)):
        for split in task.splits:
            assert len(task.draw(objects, split, rng)) == task.settings.objects_per_bin
    without = make_procedural(tmp_path / "set", seed=0, train=1, test=1, validation=0)
    with pytest.raises(UserError, match="no split 'validation'; choose from train, test"):
        TASKS["regular"].draw(without, "validation", rng)


def test_a_targeted_bin_holds_three_crosses_and_four_fixed_distractors(targeted_objects):
    task, rng = TASKS["targeted"], np.random.default_rng(0)
    train, test, clutter, validation = (task.draw(targeted_objects, split, rng) for split in task.splits)
    splits = [targeted_objects[object_id].split for object_id in train]
    assert splits == ["target"] * 3 + ["distractor"] * 4
    assert train == test
    assert train[:3] == clutter[:3]
    assert train[:3] == validation[:3]
    assert len({*train[3:], *clutter[3:], *validation[3:]}) == 12


def test_lifting_another_object_beside_a_target_still_counts(targeted_objects):
    task = TASKS["targeted"]
    target, other = targeted_objects.ids("target")[0], targeted_objects.ids("distractor")[0]
    assert task.rewarded(targeted_objects, (other, target)) == target
    assert task.rewarded(targeted_objects, (other,)) is None
    assert task.rewarded(targeted_objects, ()) is None
    assert TASKS["regular"].rewarded(targeted_objects, (other, target)) == other


def test_a_task_is_rebuilt_from_its_settings_in_a_manifest():
    other = dataclasses.replace(TASKS["targeted"].settings, finger_force=17.0)
    task = task_from_json(other.to_json())
    assert task == TASKS["targeted"].with_settings(other)
    assert type(task) is not RegularGrasping


def test_a_task_of_ones_own_is_named_by_its_module_and_rebuilt_with_its_own_settings(own_module, regular_objects):
    for task in (task_named(f"{own_module}:light"), task_named(f"{own_module}:LightGrasping")):
        assert (task.settings.objects_per_bin, task.settings.max_steps) == (2, 6)
        assert task.settings.name in (f"{own_module}:light", f"{own_module}:LightGrasping")
    lighter = task.with_settings(dataclasses.replace(task.settings, heaviest=0.0))
    assert task_from_json(lighter.settings.to_json()) == lighter
    ids = lighter.draw(regular_objects, "test", np.random.default_rng(0))
    assert len(ids) == 2 and lighter.rewarded(regular_objects, ids) is None


def test_unknown_names_are_refused_in_one_line(regular_objects, own_module):
    with pytest.raises(UserError, match="unknown task 'stacking'; choose from regular, targeted, or module:task"):
        task_named("stacking")
    with pytest.raises(UserError, match="has no 'settings'; derive it from"):
        task_named(f"{own_module}:nothing")
    with pytest.raises(UserError, match="has no 'absent'"):
        task_named(f"{own_module}:absent")
    with pytest.raises(UserError, match="No module named 'no_such_module'"):
        task_named("no_such_module:task")
    with pytest.raises(UserError, match="the regular task has train, test"):
        TASKS["regular"].draw(regular_objects, "test-clutter", np.random.default_rng(0))
    with pytest.raises(UserError, match="no split 'target'; choose from train, test"):
        TASKS["targeted"].draw(regular_objects, "train", np.random.default_rng(0))
    with pytest.raises(UserError, match="of simulator version 0"):
        task_from_json({**TASKS["regular"].settings.to_json(), "simulator_version": 0})
