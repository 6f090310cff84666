import numpy as np
import pytest
import trimesh

from graspq.objects.decomposition import coarse_hull

BOX = (0.03, 0.05, 0.08)


def test_a_hull_of_many_corners_is_coarsened_to_within_2_percent_and_a_small_one_is_exact() -> None:
    ball = trimesh.creation.icosphere(4, 0.04)
    coarse = coarse_hull(ball.vertices)
    assert len(coarse.vertices) <= 64
    np.testing.assert_allclose(np.ptp(coarse.vertices, axis=0), 0.08, rtol=0.03)
    assert coarse.volume > 0.88 * ball.volume
    box = trimesh.creation.box(BOX)
    assert coarse_hull(box.vertices).volume == pytest.approx(np.prod(BOX))
