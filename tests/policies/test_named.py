"""A user's object is made by name, checked at every step, and made again in every worker."""

import pickle
import sys
from pathlib import Path

import numpy as np
import pytest

from graspq.common.errors import UserError
from graspq.policies.named import UserPolicy, policy_named
from graspq.policies.oracle import Oracle
from graspq.policies.random import RandomPolicy
from graspq.sim.episode import GraspSimulation
from graspq.sim.observation import Observation
from graspq.sim.play import play
from graspq.sim.task import TASKS

SOURCE = """
class Down:
    exploration = 0.25
    def act(self, observation, rng): return [0, 0, -1, 0.5]
class Looks:
    def begin(self, simulation): self.count, self.q = len(simulation.object_ids), None
    def act(self, observation, rng):
        self.q = self.count / 10
        return rng.uniform(-1, 1, 4)
class Wrong:
    def __init__(self, answer): self.answer = answer
    def act(self, observation, rng): return self.answer
def three(): return Wrong([0.0, 0.0, 0.0])
def nan(): return Wrong([0.0, float("nan"), 0.0, 0.0])
def large(): return Wrong([0.0, 0.0, -3.0, 0.0])
def text(): return Wrong("down")
def nothing(): return None
def broken(): raise KeyError("weights")
class Fails:
    def act(self, observation, rng): return {}["weights"]
"""
SEEN = Observation(np.zeros((64, 64, 3), np.uint8), 0, np.zeros(4, np.float32))


@pytest.fixture
def user_module(tmp_path, monkeypatch):
    name = f"policy_of_{abs(hash(str(tmp_path)))}"
    (tmp_path / f"{name}.py").write_text(SOURCE)
    monkeypatch.chdir(tmp_path)
    return name


def test_a_name_gives_a_policy():
    assert policy_named("random") == RandomPolicy()
    assert isinstance(policy_named("oracle"), Oracle)
    with pytest.raises(UserError, match="expected random, oracle, or module:factory"):
        policy_named("oracel")


def test_a_users_object_acts_and_is_told_from_others(user_module):
    policy = policy_named(f"{user_module}:Down")
    assert policy.act(SEEN, np.random.default_rng(0)).tolist() == [0.0, 0.0, -1.0, 0.5]
    assert (policy.name, policy.exploration, policy.q) == (f"{user_module}:Down", 0.25, None)
    assert len(policy.identity()["source_sha256"]) == 64
    assert str(Path.cwd()) not in sys.path


def test_an_object_that_looks_into_the_simulation_does_so_at_the_beginning(user_module, regular_objects):
    policy = pickle.loads(pickle.dumps(UserPolicy(f"{user_module}:Looks")))
    with GraspSimulation(TASKS["regular"], regular_objects) as simulation:
        simulation.load(regular_objects.ids("train")[:3])
        simulation.reset(np.random.default_rng(0))
        played = play(simulation, policy, np.random.default_rng(1))
    assert played.q == 0.3
    np.testing.assert_allclose(played.actions[0], np.random.default_rng(1).uniform(-1, 1, 4), rtol=1e-6)


@pytest.mark.parametrize(
    ("factory", "said"),
    [
        ("three", r"returned the shape \[3\], expected 4 finite numbers in \[-1, 1\]"),
        ("nan", "returned nan, expected 4 finite numbers"),
        ("large", r"returned -3.0, expected 4 finite numbers"),
        ("text", "returned str, expected 4 finite numbers"),
        ("nothing", r"expected an object with act\(observation, rng\), the factory returned NoneType"),
        ("broken", r"cannot be made, KeyError: 'weights' at policy_of_\d+.py:18"),
        ("Fails", r"act\(\) failed, KeyError: 'weights' at policy_of_\d+.py:20"),
        ("absent", "has no 'absent'"),
    ],
)
def test_a_users_mistake_in_a_policy_is_one_line(user_module, factory, said):
    with pytest.raises(UserError, match=said) as caught:
        UserPolicy(f"{user_module}:{factory}").act(SEEN, np.random.default_rng(0))
    assert "\n" not in caught.value.message


def test_a_missing_module_is_refused():
    with pytest.raises(UserError, match="ModuleNotFoundError: No module named 'no_such_module'"):
        policy_named("no_such_module:make")
