import numpy as np
import pytest

from graspq.common.errors import UserError
from graspq.common.seeding import generator, integer_seed
from graspq.datagen.collect import Block, Collection, collect_block, collected
from graspq.datagen.settings import CollectionSettings
from graspq.engine import EngineSettings
from graspq.sim.episode import GraspSimulation
from graspq.sim.task import TASKS

SETTINGS = CollectionSettings(seed=4, block_size=6)


def same(first, second):
    for ours, theirs in zip(first, second, strict=True):
        np.testing.assert_array_equal(ours.images, theirs.images)
        np.testing.assert_array_equal(ours.final_image, theirs.final_image)
        np.testing.assert_array_equal(ours.actions, theirs.actions)
        np.testing.assert_array_equal(ours.gripper_poses, theirs.gripper_poses)
        np.testing.assert_array_equal(ours.object_poses, theirs.object_poses)
        np.testing.assert_array_equal(ours.rewards, theirs.rewards)
        assert (ours.seed, ours.object_ids, ours.ended_by) == (theirs.seed, theirs.object_ids, theirs.ended_by)
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
    limits = np.array(TASKS["regular"].action.limits)
    for episode in alone:
        assert (episode.rewards[:-1] == 0).all()
        assert episode.rewards[-1] == float(episode.success)
        poses = np.concatenate([episode.gripper_poses, episode.final_pose[None]])
        free = np.abs(poses[:-1, :2] - [0.55, 0]).max(axis=1) < 0.06  # away from the workspace's bounds
        error = np.abs(np.diff(poses, axis=0) - episode.actions * limits)[free]
        assert error[:, :2].max() < 0.008


def test_the_random_policy_takes_the_same_draws_as_ever(alone):
    for episode in alone:
        assert episode.seed == integer_seed("datagen/episode", SETTINGS.seed, episode.episode_id)
        draws = generator("datagen/policy", episode.seed)
        expected = []
        for _ in range(episode.steps):
            action = draws.uniform(-1.0, 1.0, size=4)
            if draws.random() < 0.9:
                action[2] = -1.0
            expected.append(action)
        np.testing.assert_array_equal(episode.actions, np.float32(expected))
        assert (episode.policy, episode.exploration) == ("random", 0.9)


def test_another_policy_sees_image_and_step_and_is_named_and_scenes_stay_the_same(regular_objects, alone):
    class Watcher:
        name, exploration = "watcher", 0.25

        def __init__(self):
            self.seen = []

        def act(self, observation, rng):
            self.seen.append((observation.image, observation.step))
            return np.array([0, 0, -1 if observation.step > 1 else 0, 0], np.float32)

    watcher = Watcher()
    with GraspSimulation(TASKS["regular"], regular_objects) as simulation:
        made = collect_block(simulation, SETTINGS, 5, 2, watcher)
    images = np.concatenate([episode.images for episode in made])
    np.testing.assert_array_equal(np.stack([image for image, _ in watcher.seen]), images)
    assert [step for _, step in watcher.seen] == [*range(made[0].steps), *range(made[1].steps)]
    assert [(episode.policy, episode.exploration) for episode in made] == [("watcher", 0.25)] * 2
    np.testing.assert_array_equal(made[0].images[0], alone[0].images[0])
    np.testing.assert_array_equal(made[0].object_poses, alone[0].object_poses)


def test_a_block_after_short_ones_can_begin_with_any_episode(regular_objects, alone):
    with GraspSimulation(TASKS["regular"], regular_objects) as simulation:
        made = collect_block(simulation, SETTINGS, 5, 2, first_episode=7)
    assert [episode.episode_id for episode in made] == [7, 8] and made[0].object_ids == alone[0].object_ids


def test_another_seed_or_block_gives_other_objects(regular_objects, alone):
    with GraspSimulation(TASKS["regular"], regular_objects) as simulation:
        other = collect_block(simulation, CollectionSettings(seed=5, block_size=6), 5, 1)
    assert other[0].object_ids != alone[0].object_ids


def test_a_worker_gives_the_episodes_of_this_process(regular_objects):
    work = Collection(TASKS["regular"].settings.to_json(), regular_objects.folder, SETTINGS)
    blocks = [Block(1, 2, 5), Block(5, 2, 30)]
    here, there = (dict(collected(work, blocks, EngineSettings(workers=workers))) for workers in (0, 1))
    assert all(same(here[block], there[block]) for block in blocks)
    assert [episode.episode_id for episode in there[blocks[0]]] == [5, 6]


def test_a_mistake_of_the_user_in_a_worker_arrives_as_one(regular_objects):
    work = Collection(TASKS["targeted"].settings.to_json(), regular_objects.folder, SETTINGS)
    with pytest.raises(UserError, match="'target'"):
        list(collected(work, [Block(0, 1, 0)], EngineSettings(workers=1)))
