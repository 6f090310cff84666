import numpy as np
import pytest

from graspq.common.seeding import generator
from graspq.objects.geometry import convex_hull, union_mass_properties
from graspq.objects.resting import resting_poses
from graspq.objects.shapes import cuboid


def test_a_cube_stands_on_each_of_its_six_sides_alike() -> None:
    poses = resting_poses(cuboid((0.04, 0.04, 0.04)).vertices, np.zeros(3))
    assert len(poses) == 6
    for pose in poses:
        assert pose.probability == pytest.approx(1 / 6, abs=1e-9)


def test_a_board_rests_on_its_largest_side_most_often() -> None:
    poses = resting_poses(cuboid((0.10, 0.06, 0.02)).vertices, np.zeros(3))
    assert sum(pose.probability for pose in poses) == pytest.approx(1)
    assert poses[0].probability > 0.3
    np.testing.assert_allclose(np.abs(poses[0].up), [0, 0, 1], atol=1e-9)


def test_a_slanted_tower_never_rests_on_the_foot_it_topples_from() -> None:
    foot = [[x, y, 0.0] for x in (-0.01, 0.01) for y in (-0.01, 0.01)]
    head = [[x + 0.06, y, 0.08] for x in (-0.01, 0.01) for y in (-0.01, 0.01)]
    tower = convex_hull(np.array(foot + head))
    centre = union_mass_properties([tower]).centre
    for pose in resting_poses(tower.vertices, centre, least=0.0):
        assert pose.up[2] < 0.99


def test_the_centre_of_mass_lies_above_the_face_an_object_rests_on() -> None:
    for index in range(10):
        stone = convex_hull(generator("tests/resting", index).normal(size=(14, 3)))
        centre = union_mass_properties([stone]).centre
        for pose in resting_poses(stone.vertices, centre, least=1e-6):
            along = stone.vertices @ pose.up
            face = stone.vertices[along < along.min() + 1e-9]
            right = np.cross(pose.up, np.eye(3)[int(np.abs(pose.up).argmin())])
            flat = np.stack([right, np.cross(pose.up, right)], axis=1)
            corners, foot = (face - centre) @ flat, np.zeros(2)
            cross = [np.linalg.det(np.stack([corners[(i + 1) % 3] - corners[i], foot - corners[i]])) for i in range(3)]
            assert len(face) == 3
            assert all(value > 0 for value in cross) or all(value < 0 for value in cross)
