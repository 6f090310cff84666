import numpy as np
import pytest

from graspq.policies.random import RandomPolicy
from graspq.sim.episode import GraspSimulation
from graspq.sim.play import play
from graspq.sim.task import TASKS


class Watcher:
    """Goes down from its third action on; notes what it is told."""

    name, exploration = "watcher", 0.0

    def __init__(self):
        self.begun, self.seen, self.q = [], [], None

    def begin(self, simulation):
        self.begun.append(simulation.step_count)

    def act(self, observation, rng):
        self.seen.append(observation)
        self.q = observation.step / 10
        return np.array([0, 0, -1 if observation.step > 1 else 0, 0], np.float32)


@pytest.fixture
def simulation(regular_objects):
    with GraspSimulation(TASKS["regular"], regular_objects) as made:
        made.load(regular_objects.ids("train")[:5])
        yield made


def test_an_episode_is_played_to_its_end_and_all_of_it_is_kept(simulation):
    simulation.reset(np.random.default_rng(0))
    poses, watcher = simulation.object_poses(), Watcher()
    played = play(simulation, watcher, np.random.default_rng(1))
    assert (watcher.begun, played.ended_by, played.q) == ([0], "height", 0.5)
    assert [observation.step for observation in watcher.seen] == list(range(6))
    assert played.observations == tuple(watcher.seen)
    np.testing.assert_array_equal(played.object_poses, poses)
    np.testing.assert_array_equal(played.actions[:, 2], [0, 0, -1, -1, -1, -1])
    assert played.rewards.tolist() == [0.0] * 5 + [float(played.success)]
    assert played.frames.shape == (7, 64, 64, 3)
    assert (played.frames[-1] != played.frames[-2]).any(), "the view after the lift"


def test_what_is_watched_changes_nothing(simulation):
    def outcome():
        simulation.load(simulation.object_ids)
        simulation.reset(np.random.default_rng(3))
        played = play(simulation, RandomPolicy(), np.random.default_rng(4))
        return played.actions.tobytes(), played.final_pose.tobytes(), simulation.object_poses().tobytes()

    count = []
    plain = outcome()
    with simulation.world.watched(lambda: count.append(simulation.render(8).mean())):
        assert outcome() == plain
    assert len(count) > 100
    seen = len(count)
    assert outcome() == plain and len(count) == seen
