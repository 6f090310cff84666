import numpy as np
import pytest

from graspq.common.seeding import generator
from graspq.objects.geometry import convex_hull
from graspq.objects.graspable import graspable_share
from graspq.objects.shapes import cuboid, rotation


def share_of(*sides: tuple[float, float, float]) -> float:
    """The share of bodies of boxes about the origin, turned at random."""
    turn = rotation(generator("tests/graspable", len(sides)))
    return graspable_share([convex_hull(cuboid(box).vertices @ turn.T) for box in sides])


def test_a_cube_of_4_cm_can_always_be_taken_and_one_of_9_cm_never() -> None:
    assert share_of((0.04, 0.04, 0.04)) == pytest.approx(1)
    assert share_of((0.09, 0.09, 0.09)) == 0


def test_a_long_bar_is_taken_across() -> None:
    assert share_of((0.16, 0.03, 0.03)) > 0.95


def test_a_thin_board_can_be_taken_on_edge_alone() -> None:
    lying = 2 * np.arcsin((0.06 / np.hypot(0.06, 0.012)) ** 2) / np.pi  # solid angle of the two large faces, of all
    assert share_of((0.06, 0.06, 0.012)) == pytest.approx(1 - lying, abs=0.01)


def test_a_body_wider_than_the_jaw_is_taken_by_an_arm_but_not_where_the_other_arms_stop_the_fingers() -> None:
    assert share_of((0.14, 0.025, 0.025), (0.025, 0.14, 0.025)) > 0.9
    walls = [((0.16, 0.03, 0.03), (0.0, side * 0.048, 0.0)) for side in (-1, 1)]
    bars = [cuboid((0.16, 0.03, 0.03)), *(cuboid(*wall) for wall in walls)]
    assert graspable_share(bars) < graspable_share(bars[:1])
