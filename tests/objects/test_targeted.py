from pathlib import Path

import numpy as np
import pytest

from graspq.objects.geometry import half_spaces
from graspq.objects.targeted import PURPLE, TARGET, cross, make_targeted


def test_the_set_holds_a_purple_cross_four_fixed_and_twice_four_unseen_distractors(tmp_path: Path) -> None:
    made = make_targeted(tmp_path / "targeted", seed=0)
    assert {split: len(made.ids(split)) for split in made.splits} == {
        "target": 1,
        "distractor": 4,
        "test-distractor": 4,
        "validation-distractor": 4,
    }
    assert made[TARGET].color == PURPLE
    assert made[TARGET].split == "target"
    assert len({record.color for record in made.objects}) == 13
    made.verify()


def test_the_same_seed_gives_the_same_set_and_the_target_does_not_depend_on_it(tmp_path: Path) -> None:
    first, again, other = (make_targeted(tmp_path / name, seed=seed) for name, seed in (("a", 3), ("b", 3), ("c", 4)))
    assert first.digest() == again.digest()
    assert first.digest() != other.digest()
    assert first[TARGET] == other[TARGET]


def test_the_cross_has_the_volume_and_inertia_of_two_crossing_bars_and_open_corners() -> None:
    model = cross()
    long, wide, density = 0.085, 0.026, 500.0
    volume = 2 * long * wide * wide - wide**3
    assert model.volume == pytest.approx(volume, rel=1e-6)
    assert model.mass == pytest.approx(density * volume, rel=1e-6)
    upright = density * (2 * long * wide**2 * (long**2 + wide**2) - 2 * wide**5) / 12
    assert max(model.inertia) == pytest.approx(upright, rel=1e-6)
    corner = np.array([0.03, 0.03, 0.0])
    for part in model.parts:
        planes = half_spaces(part)
        assert (planes[:, :3] @ corner + planes[:, 3]).max() > 0
