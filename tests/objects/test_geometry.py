import math

import numpy as np
import pytest
import trimesh

from graspq.common.seeding import generator
from graspq.objects.geometry import convex_hull, half_spaces, principal_axes, union_mass_properties
from graspq.objects.shapes import cuboid, rotation


def _cylinder(radius: float, height: float, sides: int) -> trimesh.Trimesh:
    angles = 2 * np.pi * np.arange(sides) / sides
    circle = np.stack([radius * np.cos(angles), radius * np.sin(angles)], axis=1)
    return convex_hull(np.vstack([np.c_[circle, np.full(sides, z)] for z in (-height / 2, height / 2)]))


def test_a_box_has_the_volume_and_inertia_of_the_closed_form() -> None:
    x, y, z = 0.03, 0.05, 0.08
    properties = union_mass_properties([cuboid((x, y, z), (0.4, -0.2, 0.1))])
    volume = x * y * z
    assert properties.volume == pytest.approx(volume, rel=1e-12)
    np.testing.assert_allclose(properties.centre, [0.4, -0.2, 0.1], atol=1e-12)
    expected = volume / 12 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])
    # Steiner's theorem at 0.46 m costs four digits.
    np.testing.assert_allclose(properties.inertia, np.diag(expected), atol=1e-10 * expected.max())


def test_a_regular_prism_has_the_volume_and_inertia_of_the_closed_form_and_tends_to_the_cylinder() -> None:
    radius, height, sides = 0.02, 0.07, 12
    properties = union_mass_properties([_cylinder(radius, height, sides)])
    area = sides / 2 * radius**2 * math.sin(2 * math.pi / sides)
    second = area * radius**2 * (2 + math.cos(2 * math.pi / sides)) / 6  # polar second moment of a regular polygon
    inertia = properties.inertia
    assert properties.volume == pytest.approx(area * height, rel=1e-12)
    assert inertia[2, 2] == pytest.approx(second * height, rel=1e-9)
    assert inertia[0, 0] == pytest.approx(second * height / 2 + area * height**3 / 12, rel=1e-9)
    fine = union_mass_properties([_cylinder(radius, height, 720)])
    volume = math.pi * radius**2 * height
    assert fine.volume == pytest.approx(volume, rel=2e-5)
    assert fine.inertia[2, 2] == pytest.approx(volume * radius**2 / 2, rel=4e-5)
    assert fine.inertia[0, 0] == pytest.approx(volume * (3 * radius**2 + height**2) / 12, rel=4e-5)


def test_what_two_crossing_bars_share_counts_once() -> None:
    long, wide = 0.08, 0.02
    properties = union_mass_properties([cuboid((long, wide, wide)), cuboid((wide, long, wide))])
    assert properties.volume == pytest.approx(2 * long * wide**2 - wide**3, rel=1e-9)
    bars = (long * wide**2 / 12) * (long**2 + wide**2) * 2 - wide**3 / 12 * (2 * wide**2)
    assert properties.inertia[2, 2] == pytest.approx(bars, rel=1e-9)


def test_three_crossing_bars_need_the_triple_intersection() -> None:
    long, wide = 1.0, 0.2
    bars = [cuboid((long, wide, wide)), cuboid((wide, long, wide)), cuboid((wide, wide, long))]
    assert union_mass_properties(bars).volume == pytest.approx(3 * long * wide**2 - 2 * wide**3, rel=1e-9)


def test_parts_that_touch_add_up_and_a_part_inside_another_adds_nothing() -> None:
    left, right = cuboid((1, 1, 1)), cuboid((1, 1, 1), (1, 0, 0))
    assert union_mass_properties([left, right]).volume == pytest.approx(2, rel=1e-4)
    assert union_mass_properties([left, cuboid((0.3, 0.2, 0.4), (0.1, 0.2, 0.0))]).volume == pytest.approx(1, rel=1e-9)


def test_the_volume_of_a_random_union_agrees_with_sampling() -> None:
    rng = generator("tests/union")
    parts = [convex_hull(rng.normal(size=(12, 3)) * 0.4 + rng.uniform(-0.4, 0.4, size=3)) for _ in range(4)]
    points = np.concatenate([part.vertices for part in parts])
    low, high = points.min(axis=0), points.max(axis=0)
    samples = rng.uniform(low, high, size=(200_000, 3))
    inside = np.zeros(len(samples), dtype=bool)
    for part in parts:
        planes = half_spaces(part)
        inside |= (samples @ planes[:, :3].T + planes[:, 3] <= 0).all(axis=1)
    exact, box = union_mass_properties(parts), float(np.prod(high - low))
    spread = box * math.sqrt(inside.mean() * (1 - inside.mean()) / len(samples))
    assert abs(exact.volume - box * inside.mean()) < 4 * spread
    np.testing.assert_allclose(exact.centre, samples[inside].mean(axis=0), atol=0.01)


def test_a_hull_is_watertight_faces_outward_and_drops_inner_points() -> None:
    points = generator("tests/hull").normal(size=(40, 3))
    hull = convex_hull(np.vstack([points, points.mean(axis=0)]))
    assert hull.is_watertight
    assert hull.is_winding_consistent
    assert hull.volume > 0
    assert len(np.unique(hull.faces)) == len(hull.vertices)


def test_flat_points_have_no_hull() -> None:
    with pytest.raises(ValueError, match="no volume"):
        convex_hull(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]))


def test_principal_axes_diagonalise_and_turn_right_handed() -> None:
    for index in range(20):
        turn = rotation(generator("tests/axes", index))
        inertia = turn @ np.diag([1.0, 2.5, 3.0]) @ turn.T
        moments, axes = principal_axes(inertia)
        np.testing.assert_allclose(axes.T @ inertia @ axes, np.diag(moments), atol=2e-6)
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1)
        np.testing.assert_allclose(np.sort(moments), [1.0, 2.5, 3.0], atol=1e-6)


def test_a_cube_keeps_the_axes_it_was_built_along() -> None:
    _, axes = principal_axes(union_mass_properties([cuboid((1, 1, 1))]).inertia)
    np.testing.assert_array_equal(axes, np.eye(3))
