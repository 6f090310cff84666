import numpy as np
import pytest

from graspq.objects.drawing import draw, standing
from graspq.objects.shapes import cuboid


def test_an_object_is_drawn_in_its_colour_on_a_light_floor_with_a_shadow() -> None:
    up = np.array([0.0, 0.0, 1.0])
    picture = draw(standing([cuboid((0.05, 0.05, 0.05))], up), (1.0, 0.0, 0.0), 64, 0.15).astype(int)
    red = picture[..., 0] - picture[..., 1]
    assert red[32, 32] > 100
    assert (red > 60).mean() == pytest.approx(0.05**2 * 1.6 / 0.15**2, rel=0.35)
    assert picture[0, 0].min() > 240
    grey = (np.ptp(picture, axis=-1) < 8) & (picture[..., 0] < 225)
    assert grey.sum() > 20


def test_an_object_stands_on_the_floor() -> None:
    (part,) = standing([cuboid((0.05, 0.03, 0.08), (1.0, 2.0, 3.0))], np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(part.bounds[:, 2], [0.0, 0.05], atol=1e-12)
    assert part.volume == pytest.approx(0.05 * 0.03 * 0.08)
    # Its long side goes across the picture.
    assert np.ptp(part.vertices[:, 0]) > np.ptp(part.vertices[:, 1])


def test_the_nearer_of_two_parts_is_seen_and_the_light_from_the_left_leaves_a_shadow_on_the_right() -> None:
    # Upright boards, 6 cm high: one near the viewer, and one behind it of twice the width.
    near, far = cuboid((0.04, 0.01, 0.06), (0.0, -0.03, 0.03)), cuboid((0.08, 0.01, 0.06), (0.0, 0.03, 0.03))
    grey = (0.6, 0.6, 0.6)
    both, behind = (draw(parts, grey, 64, 0.2).astype(int) for parts in ([near, far], [far]))
    # What the near board hides of the far one, and the shadow it casts on it, differ; beside it they do not.
    assert (both != behind).any(axis=-1)[:, 26:38].sum() > 100
    np.testing.assert_array_equal(both[:, :12], behind[:, :12])
    floor = draw([near], grey, 64, 0.2).astype(int)
    shaded = floor[..., 0] < 230
    assert shaded[:, 40:].sum() > 10
    assert shaded[:, :20].sum() == 0
