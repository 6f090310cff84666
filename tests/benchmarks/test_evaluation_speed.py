"""The rivals of evaluation play the same episodes and find the same actions."""

import pickle

import numpy as np
import pytest

from graspq.benchmarks.evaluation_speed import at_once, check_rivals, one_at_a_time, together
from graspq.benchmarks.rivals import ONCE, TILED, WAYS, asking
from graspq.common.errors import UserError
from graspq.evaluate.rollout import Rollouts
from graspq.evaluate.scenes import Scenes
from graspq.policies.of_run import Origin, RunPolicy
from graspq.sim.task import task_named
from graspq.train.acting import Acting, ActorNetwork, StochasticSearch
from graspq.train.networks import build, q_network, state_network
from graspq.train.networks.network import NetworkSpecification
from graspq.train.search_settings import CemSettings
from graspq.train.state import seeded

TASK = task_named("regular")


def policy_of(selection, **makers):
    specification = NetworkSpecification("paper", (64, 64, 3), TASK.action, 15, "logistic")
    networks = {part: build(make, specification, seeded("tests/rivals")).eval() for part, make in makers.items()}
    acting = Acting(networks, {}, TASK.action)
    return RunPolicy(Origin("mc", 0, "", {}, {}, specification), acting, selection, CemSettings(samples=12), "cpu")


@pytest.fixture(scope="module")
def searching():
    return policy_of(StochasticSearch(), q=q_network)


def test_every_way_of_asking_finds_the_same_action(searching):
    check_rivals(searching)


def test_a_way_that_asks_about_another_step_is_refused(searching, monkeypatch):
    monkeypatch.setitem(WAYS, TILED, lambda network, image, step: network.at(255 - image, step))
    with pytest.raises(UserError, match="64 tiled copies: differs from ours"):
        check_rivals(searching)


def test_a_policy_without_a_search_is_refused():
    with pytest.raises(UserError, match="acts by an actor network"):
        check_rivals(policy_of(ActorNetwork(), actor=state_network(4)))


def test_a_rival_travels_to_workers_and_leaves_the_policy_as_it_was(searching):
    network = searching.acting.q
    there = pickle.loads(pickle.dumps(asking(searching, TILED)))
    assert there.acting.q.way == TILED and searching.acting.q is network


def test_rivals_share_the_episodes_of_an_evaluation(searching, regular_objects):
    rollouts = Rollouts(Scenes(TASK, regular_objects.folder, "test", 0), searching)
    alone, successes = one_at_a_time(rollouts, range(2))
    seconds, shared = together(Rollouts(rollouts.scenes, asking(searching, ONCE)), 2)
    ours, played = at_once(rollouts, 2)
    assert successes == shared == played and set(shared) == {0, 1}
    assert np.isfinite([alone, seconds, ours]).all() and min(alone, seconds, ours) > 0
