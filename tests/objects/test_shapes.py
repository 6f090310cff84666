import numpy as np
import pytest

from graspq.common.seeding import generator
from graspq.objects.geometry import half_spaces
from graspq.objects.shapes import FAMILIES, MOST_PARTS, SIMPLE, draw_shape, rotation


@pytest.mark.parametrize("family", FAMILIES)
def test_every_part_of_a_family_is_convex_watertight_and_of_few_faces(family: str) -> None:
    for index in range(15):
        for part in FAMILIES[family](generator("tests/shapes", index)):
            planes = half_spaces(part)
            assert (planes[:, :3] @ part.vertices.T + planes[:, 3:]).max() < 1e-9
            assert part.is_watertight
            assert part.volume > 0
            assert len(part.faces) <= 100


@pytest.mark.parametrize("family", FAMILIES)
def test_an_object_has_at_most_four_parts_of_a_simple_family_and_eight_of_another(family: str) -> None:
    for index in range(15):
        shape = draw_shape(generator("tests/objects", index), family)
        assert 1 <= len(shape.parts) <= (4 if family in SIMPLE else MOST_PARTS)
        assert shape.families[0] == family
        assert set(shape.families[1:]) <= set(SIMPLE)


def test_smaller_parts_are_of_the_asked_families_alone() -> None:
    for extras in (["stone"], []):
        drawn = {
            name for index in range(15) for name in draw_shape(generator("tests/extras", index), "box", extras).families
        }
        assert drawn == {"box", *extras}


def test_the_same_generator_draws_the_same_object_and_another_one_a_different_object() -> None:
    first, second, other = (draw_shape(generator("tests/same", key), "stone") for key in (1, 1, 2))
    for one, two in zip(first.parts, second.parts, strict=True):
        np.testing.assert_array_equal(one.vertices, two.vertices)
        np.testing.assert_array_equal(one.faces, two.faces)
    assert not np.array_equal(first.parts[0].vertices, other.parts[0].vertices)


def test_drawn_rotations_are_proper_and_uniform() -> None:
    rng = generator("tests/rotations")
    turns = np.array([rotation(rng) for _ in range(2000)])
    np.testing.assert_allclose(np.linalg.det(turns), 1, atol=1e-12)
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turns.shape), atol=1e-12)
    assert np.abs(turns.mean(axis=0)).max() < 4 / np.sqrt(3 * 2000)
