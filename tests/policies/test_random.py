import numpy as np
import pytest

from graspq.common.errors import UserError
from graspq.policies.random import RandomPolicy


def test_actions_are_uniform_but_for_the_descent():
    rng = np.random.default_rng(0)
    actions = np.stack([RandomPolicy(0.9).act(None, rng) for _ in range(20_000)])
    assert actions.dtype == np.float32
    assert (actions[:, 2] == -1).mean() == pytest.approx(0.9, abs=0.01)
    free = actions[:, [0, 1, 3]]
    np.testing.assert_allclose(free.mean(axis=0), 0, atol=0.02)
    np.testing.assert_allclose(free.std(axis=0), 1 / np.sqrt(3), atol=0.01)
    assert np.abs(actions).max() <= 1


def test_a_probability_beyond_one_is_refused():
    with pytest.raises(UserError, match=r"at least 0 and at most 1, got 1\.5"):
        RandomPolicy(1.5)
