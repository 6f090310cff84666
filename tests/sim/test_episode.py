import numpy as np
import pytest

from graspq.policies.random import RandomPolicy
from graspq.sim.episode import GraspSimulation
from graspq.sim.task import TASKS

TASK = TASKS["regular"]


@pytest.fixture
def simulation(regular_objects):
    with GraspSimulation(TASK, regular_objects) as made:
        made.load(TASK.draw(regular_objects, "train", np.random.default_rng(0)))
        yield made


def test_the_reward_comes_at_the_last_step_alone_and_equals_success(simulation):
    successes = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        simulation.reset(rng)
        outcome = simulation.step(RandomPolicy().act(None, rng))
        while not outcome.terminated:
            assert outcome.reward == 0.0
            assert outcome.info == {}
            outcome = simulation.step(RandomPolicy().act(None, rng))
        assert outcome.reward == float(outcome.info["success"])
        assert (outcome.info["lifted_object"] is not None) == outcome.info["success"]
        successes += outcome.info["success"]
    assert 0 < successes < 12


def test_going_below_the_trigger_height_ends_the_episode(simulation):
    simulation.reset(np.random.default_rng(0))
    outcomes = [simulation.step([0, 0, -1, 0]) for _ in range(4)]
    assert [outcome.terminated for outcome in outcomes] == [False, False, False, True]
    assert outcomes[-1].info["ended_by"] == "height"
    assert outcomes[-1].info["final_pose"][2] == pytest.approx(0.04, abs=0.004)


def test_the_gripper_closes_where_it_is_after_fifteen_actions(simulation):
    simulation.reset(np.random.default_rng(0))
    outcomes = [simulation.step([0, 0, 0.5, 0]) for _ in range(15)]
    assert [outcome.terminated for outcome in outcomes] == [False] * 14 + [True]
    assert outcomes[-1].info["ended_by"] == "T"
    assert outcomes[-1].reward == 0.0
    assert outcomes[-1].info["final_pose"][2] == pytest.approx(TASK.settings.home_height, abs=0.002)
    with pytest.raises(RuntimeError, match="call reset first"):
        simulation.step([0, 0, 0, 0])


def test_actions_are_displacements_in_units_of_the_limits(simulation):
    start = simulation.reset(np.random.default_rng(0)).gripper_pose
    moved = simulation.step([0.5, -1.0, -0.25, 1.0]).observation.gripper_pose
    error = np.abs(moved - start - [0.03, -0.06, -0.015, 0.4])
    assert (error < [0.003, 0.003, 0.003, 0.01]).all(), error


def test_actions_beyond_one_are_clipped_and_the_workspace_bounds_the_gripper(simulation):
    simulation.reset(np.random.default_rng(0))
    for _ in range(5):
        pose = simulation.step([9, 9, 9, 9]).observation.gripper_pose
    np.testing.assert_allclose(pose, [0.55 + 0.13, 0.13, 0.28, 1.75], atol=0.004)


@pytest.mark.parametrize("action", [[0, 0, 0], [0, 0, 0, float("nan")], np.zeros((1, 4))])
def test_what_is_no_action_is_refused(simulation, action):
    simulation.reset(np.random.default_rng(0))
    with pytest.raises(ValueError, match="an action is 4 finite numbers"):
        simulation.step(action)


def test_the_same_generators_give_the_same_pixels_whatever_happened_before(regular_objects):
    ids = regular_objects.ids("train")[:5]

    def play(simulation):
        rng = np.random.default_rng(5)
        simulation.load(ids)
        frames = [simulation.reset(rng).image]
        for _ in range(3):
            frames.append(simulation.step(RandomPolicy(1.0).act(None, rng)).observation.image)
        return np.stack(frames), simulation.object_poses()

    with GraspSimulation(TASK, regular_objects) as first, GraspSimulation(TASK, regular_objects) as second:
        images, poses = play(first)
        second.load(regular_objects.ids("train")[5:10])
        for seed in range(3):
            second.reset(np.random.default_rng(seed))
            second.step([0.3, 0.2, -1, 0])
        again, poses_again = play(second)
    np.testing.assert_array_equal(images, again)
    np.testing.assert_array_equal(poses, poses_again)
    assert len({frame.tobytes() for frame in images}) == 4


def test_the_objects_rest_in_the_bin_before_the_first_action(simulation):
    for seed in range(5):
        simulation.reset(np.random.default_rng(seed))
        before = simulation.object_poses()
        assert np.abs(before[:, :2] - [TASK.settings.bin_center_x, 0.0]).max() < TASK.settings.bin_half_width
        assert (before[:, 2] > 0).all() and (before[:, 2] < 0.15).all()
        simulation.step([0, 0, 0, 0])
        assert np.abs(simulation.object_poses()[:, :3] - before[:, :3]).max() < 0.002


def test_the_mask_numbers_objects_by_their_place_in_the_bin(simulation):
    simulation.reset(np.random.default_rng(0))
    simulation.arm.park()
    usual = simulation.depth_and_mask(128)[1]
    picture = simulation.render(128)
    for place, body in enumerate(simulation.bodies):
        position, orientation = body.pose()
        body.set_pose((0.3, 0.0, -1.0), orientation)
        mask = simulation.depth_and_mask(128)[1]
        changed = (simulation.render(128) != picture).any(axis=-1)
        assert changed.any()
        assert place in usual and place not in mask
        assert changed[usual == place].mean() > 0.9
        assert np.array_equal(mask[usual != place], usual[usual != place])
        body.set_pose(position, orientation)
    assert np.array_equal(simulation.render(128), picture)


def test_observations_have_depth_and_mask_on_request_alone(simulation, regular_objects):
    assert simulation.reset(np.random.default_rng(0)).depth is None
    with GraspSimulation(TASK, regular_objects, depth_and_mask=True) as other:
        other.load(simulation.object_ids)
        seen = other.reset(np.random.default_rng(0))
        np.testing.assert_array_equal(seen.image, simulation.observation.image)
        for found, expected in zip((seen.depth, seen.mask), simulation.depth_and_mask(64), strict=True):
            np.testing.assert_array_equal(found, expected)


def test_where_the_gripper_meets_nothing_it_is_put_where_simulation_would_take_it(simulation, monkeypatch):
    steps = []
    step = simulation.world.step
    monkeypatch.setattr(simulation.world, "step", lambda *args: steps.append(1) or step(*args))
    actions = [[0.5, -1.0, -0.5, 1.0], [-1.0, 0.3, 0.2, -0.4], [0.1, 0.2, -0.9, 0.7]]

    def poses():
        simulation.load(simulation.object_ids)
        simulation.reset(np.random.default_rng(0))
        steps.clear()
        rest = simulation.object_poses()
        found = np.stack([simulation.step(action).observation.gripper_pose for action in actions])
        np.testing.assert_array_equal(simulation.object_poses(), rest)
        return found, len(steps)

    put, none = poses()
    monkeypatch.setattr(simulation, "_is_clear", lambda *args: False)
    moved, some = poses()
    assert (none, some > 50) == (0, True)
    assert (np.abs(put - moved) < [0.002, 0.002, 0.002, 0.01]).all(), np.abs(put - moved).max(axis=0)


def test_what_lies_in_the_way_is_met(simulation):
    simulation.reset(np.random.default_rng(0))
    before = simulation.object_poses()
    way = (before[0, :2] - [TASK.settings.bin_center_x, 0.0]) / TASK.settings.translation_limit
    for part in (np.clip(way, -1, 1), way - np.clip(way, -1, 1)):
        simulation.step([*part, 0, 0])
    np.testing.assert_array_equal(simulation.object_poses(), before)
    while not simulation.terminated:
        simulation.step([0, 0, -1, 0])
    assert np.abs(simulation.object_poses() - before).max() > 0.001


def random_grasp(simulation, seed):
    rng = np.random.default_rng(seed)
    simulation.load(simulation.object_ids)
    simulation.reset(rng)
    outcome = simulation.step(RandomPolicy().act(None, rng))
    while not outcome.terminated:
        outcome = simulation.step(RandomPolicy().act(None, rng))
    return outcome


def test_a_grasp_whose_outcome_is_known_ends_early_as_the_whole_lift_would(simulation, monkeypatch):
    taken = []
    step = simulation.world.step

    def counted(count=1):
        taken.append(count)
        step(count)

    monkeypatch.setattr(simulation.world, "step", counted)

    def grasps():
        taken.clear()
        outcomes = [random_grasp(simulation, seed) for seed in range(10)]
        heights = [outcome.observation.gripper_pose[2] for outcome in outcomes]
        return [outcome.info["lifted_object"] for outcome in outcomes], heights, sum(taken)

    early, heights, few = grasps()
    monkeypatch.setattr(simulation, "_is_empty", lambda: False)
    whole, whole_heights, many = grasps()
    assert early == whole
    assert 0 < sum(lifted is not None for lifted in early) < 10
    np.testing.assert_allclose(heights, whole_heights, atol=0.004)
    assert few < 0.9 * many


def test_closed_fingers_that_touch_an_object_are_lifted_all_the_same(simulation):
    simulation.reset(np.random.default_rng(0))
    simulation.arm.place(simulation.arm.home(), open_gripper=False)
    simulation.world.step()
    assert simulation._is_empty()
    x, y, z = simulation.bodies[0].pose()[0]
    simulation.arm.place((x, y, z, 0.0), open_gripper=False)
    simulation.world.step()
    assert simulation.arm.finger_gap() < 0.001
    assert simulation.arm.is_touching(simulation.bodies)
    assert not simulation.arm.is_touching([])
    assert not simulation._is_empty()
