import math

import numpy as np
import pytest

from graspq.sim.clearance import Boxes, is_clear

HAND = Boxes([((-0.03, -0.1, 0.0), (0.03, 0.1, 0.1))])  # long across, as the gripper is at a turn of 0


def block(x, y, half=0.02, height=0.1):
    return ((x - half, y - half, 0.0), (x + half, y + half, height))


@pytest.mark.parametrize(
    "start, goal, clear",
    [
        ((0.0, 0.0, 0.01, 0.0), (0.0, 0.0, 0.01, 0.0), True),  # 50 mm to the block beside its long side
        ((0.0, 0.0, 0.01, math.pi / 2), (0.0, 0.0, 0.01, math.pi / 2), False),  # turned, it reaches the block
        ((0.0, 0.0, 0.01, 0.0), (0.0, 0.0, 0.01, math.pi / 2), False),
        ((0.0, 0.0, 0.11, 0.0), (0.0, 0.0, 0.11, math.pi / 2), True),  # above the block
        ((0.0, 0.0, 0.101, 0.0), (0.0, 0.0, 0.101, math.pi / 2), False),  # nearer than the margin
        ((-0.2, 0.0, 0.01, 0.0), (0.4, 0.0, 0.01, 0.0), False),  # through it, both ends clear
        ((-0.2, 0.3, 0.01, 0.0), (0.4, 0.3, 0.01, 0.0), True),  # past it
    ],
)
def test_a_way_is_clear_where_no_part_of_the_gripper_comes_near_an_obstacle(start, goal, clear):
    assert is_clear(HAND, start, goal, Boxes([block(0.1, 0.0)])) == clear


def test_nothing_is_in_the_way_where_there_is_nothing():
    assert is_clear(HAND, (0, 0, 0, 0), (1, 0, 0, 1), Boxes([]))


def test_no_point_of_the_gripper_is_inside_an_obstacle_anywhere_on_a_clear_way():
    rng = np.random.default_rng(0)
    surface = np.array(
        [[x, y, z] for x in np.linspace(-0.03, 0.03, 9) for y in np.linspace(-0.1, 0.1, 21) for z in (0.0, 0.1)]
    )
    clear = 0
    for _ in range(400):
        obstacle = block(*rng.uniform(-0.15, 0.15, 2), half=rng.uniform(0.005, 0.03), height=rng.uniform(0.02, 0.1))
        start = np.array([*rng.uniform(-0.15, 0.15, 2), rng.uniform(0.0, 0.1), rng.uniform(-1.7, 1.7)])
        goal = start + rng.uniform(-1, 1, 4) * [0.06, 0.06, 0.06, 0.4]
        if not is_clear(HAND, start.tolist(), goal.tolist(), Boxes([obstacle])):
            continue
        clear += 1
        for part in np.linspace(0.0, 1.0, 101):
            x, y, z, phi = start + (goal - start) * part
            turn = np.array([[math.cos(phi), math.sin(phi)], [-math.sin(phi), math.cos(phi)]])
            points = np.concatenate([surface[:, :2] @ turn + [x, y], surface[:, 2:] + z], axis=1)
            inside = (points > np.array(obstacle[0])) & (points < np.array(obstacle[1]))
            assert not inside.all(axis=1).any()
    assert 50 < clear < 350
