"""Settings: values out of range are refused with their option's name."""

from pathlib import Path
from typing import Any

import pytest

from graspq.common.errors import UserError
from graspq.studies.settings import SweepSettings


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"learning_rate": (0.1, 0.0)}, "--learning-rate: expected numbers above 0, got 0.0"),
        ({"width": (0,)}, "--width: expected numbers of at least 1, got 0"),
        ({"discount": (0.9, 1.1)}, "--discount: expected numbers of 0 to 1, got 1.1"),
        ({"exploration_steps": (0,)}, "--exploration-steps"),
        ({"seeds": 0}, "--seeds"),
        ({"jobs": 0}, "--jobs"),
        ({"preset": "large"}, "choose from small, paper"),
    ],
)
def test_values_out_of_range_are_refused(values: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError, match=said):
        SweepSettings(**values)


def test_the_folder_is_named_after_the_preset_where_none_is_given() -> None:
    assert SweepSettings(preset="paper").folder == Path("runs/sweep-paper")
    assert SweepSettings(out=Path("x")).folder == Path("x")
