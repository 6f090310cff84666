import numpy as np
import pytest

from graspq.datagen.collect import collect_block
from graspq.datagen.settings import CollectionSettings
from graspq.sim.episode import GraspSimulation
from graspq.sim.task import TASKS

SETTINGS = CollectionSettings(seed=4, block_size=6)


def same(first, second):
    for ours, theirs in zip(first, second, strict=True):
        np.testing.assert_array_equal(ours.images, theirs.images)
        np.testing.assert_array_equal(ours.actions, theirs.actions)
        np.testing.assert_array_equal(ours.gripper_poses, theirs.gripper_poses)
        np.testing.assert_array_equal(ours.object_poses, theirs.object_poses)
        np.testing.assert_array_equal(ours.rewards, theirs.rewards)
        assert (ours.seed, ours.object_ids, ours.end) == (theirs.seed, theirs.object_ids, theirs.end)
    return True


@pytest.fixture(scope="module")
def alone(regular_objects):
    with GraspSimulation(TASKS["regular"], regular_objects) as simulation:
        return collect_block(simulation, SETTINGS, 5, 6)


def test_a_block_made_alone_equals_the_same_block_made_after_others(regular_objects, alone):
    with GraspSimulation(TASKS["regular"], regular_objects) as simulation:
        for block in (0, 1, 2, 9):
            collect_block(simulation, SETTINGS, block, 3)
        assert same(alone, collect_block(simulation, SETTINGS, 5, 6))


def test_a_short_block_is_the_beginning_of_the_whole_one(regular_objects, alone):
    with GraspSimulation(TASKS["regular"], regular_objects) as simulation:
        assert same(alone[:2], collect_block(simulation, SETTINGS, 5, 2))


def test_episodes_of_a_block_share_objects_but_not_scenes_and_are_numbered(alone):
    assert {episode.object_ids for episode in alone} == {alone[0].object_ids}
    assert [episode.episode_id for episode in alone] == list(range(30, 36))
    assert len({episode.images[0].tobytes() for episode in alone}) == 6
    assert len({episode.seed for episode in alone}) == 6
    assert {episode.policy for episode in alone} == {"random"}


def test_the_reward_stands_on_the_last_row_and_poses_follow_the_actions(alone):
    limits = np.array(TASKS["regular"].action_limits)
    for episode in alone:
        assert (episode.rewards[:-1] == 0).all()
        assert episode.rewards[-1] == float(episode.success)
        poses = np.concatenate([episode.gripper_poses, episode.final_pose[None]])
        free = np.abs(poses[:-1, :2] - [0.55, 0]).max(axis=1) < 0.06  # away from the workspace's bounds
        error = np.abs(np.diff(poses, axis=0) - episode.actions * limits)[free]
        assert error[:, :2].max() < 0.008


def test_another_seed_or_block_gives_other_objects(regular_objects, alone):
    with GraspSimulation(TASKS["regular"], regular_objects) as simulation:
        other = collect_block(simulation, CollectionSettings(seed=5, block_size=6), 5, 1)
    assert other[0].object_ids != alone[0].object_ids
