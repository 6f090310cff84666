"""Which samples a face covers: each of a closed surface exactly one, edges included."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from graspq.sim.rasteriser import fill

SIZE = 10
# Corners on a coarse grid that the samples lie on too, so that edges often pass through samples.
places = st.integers(-12, 12).map(lambda place: place * 128)
corners = st.tuples(places, places)


def covered(*triangle, side=1):
    """Return which samples a triangle with corners (column, row) covers; either way round if `side` is None."""
    found = np.zeros((SIZE, SIZE), bool)
    for way in (-1, 1) if side is None else (side,):
        depth, owner = np.zeros((SIZE, SIZE), np.float32), np.zeros((SIZE, SIZE), np.int32)
        points = np.array([[column, row, 1.0] for column, row in triangle], dtype=float)
        fill(points, np.array([[0, 1, 2]], np.int32), 5, way, depth, owner)
        assert np.array_equal(depth > 0, owner == 5)
        found |= owner == 5
    return found


def sign(number):
    return (number > 0) - (number < 0)


def sides(point, triangle):
    """Return on which side of each edge a point lies, 0 for on its line, by whole numbers."""
    x, y = point
    edges = zip(triangle, triangle[1:] + triangle[:1], strict=True)
    return [sign((bx - ax) * (y - ay) - (by - ay) * (x - ax)) for (ax, ay), (bx, by) in edges]


@given(corners, corners, corners)
def test_a_triangle_covers_all_samples_strictly_inside_and_none_outside(a, b, c):
    found = covered(a, b, c, side=None)
    for row in range(SIZE):
        for column in range(SIZE):
            where = set(sides((256 * column - 128 * (SIZE - 1), 256 * row - 128 * (SIZE - 1)), [a, b, c]))
            if len(where) == 1 and 0 not in where:
                assert found[row, column]
            if {-1, 1} <= where:
                assert not found[row, column]


@given(corners)
def test_triangles_around_a_point_share_no_sample_and_leave_none_out(point):
    ring = [(-3000, -3000), (0, -3000), (3000, -3000), (3000, 0), (3000, 3000), (0, 3000), (-3000, 3000), (-3000, 0)]
    count = sum(covered(point, a, b, side=None).astype(int) for a, b in zip(ring, ring[1:] + ring[:1], strict=True))
    assert np.array_equal(count, np.ones((SIZE, SIZE)))


@given(corners, corners, corners)
def test_a_mirrored_triangle_covers_the_mirrored_samples(a, b, c):
    other = [(-column, row) for column, row in (a, c, b)]
    for side in (-1, 1):
        assert np.array_equal(covered(a, b, c, side=side), covered(*other, side=side)[:, ::-1])


@given(corners, corners, corners)
def test_a_triangle_is_drawn_for_one_side_alone(a, b, c):
    assert not (covered(a, b, c, side=1) & covered(a, b, c, side=-1)).any()
    assert np.array_equal(covered(a, b, c, side=1), covered(a, c, b, side=-1))
