"""Settings: values out of range are refused with their option's name."""

from pathlib import Path
from typing import Any

import pytest

from graspq.common.errors import UserError
from graspq.studies.sweep.settings import SweepSettings, Varied, parse_varied


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"learning_rate": (0.1, 0.0)}, "--learning-rate: expected numbers above 0, got 0.0"),
        ({"width": (0,)}, "--width: expected numbers of at least 1, got 0"),
        ({"discount": (0.9, 1.1)}, "--discount: expected numbers of 0 to 1, got 1.1"),
        ({"exploration_steps": (0,)}, "--exploration-steps"),
        ({"seeds": 0}, "--seeds"),
        ({"workers": -1}, "--workers"),
        ({"vary": (Varied("steps", ("1",)),)}, "--vary steps: the sweep sets --steps of each training"),
        ({"vary": (Varied("shift", ("1",)), Varied("shift", ("2",)))}, "--vary shift: named twice"),
        ({"vary": (Varied("width", ("1",)),), "width": (2,)}, "--vary width: --width names values too"),
        ({"preset": "large"}, "choose from small, paper"),
    ],
)
def test_values_out_of_range_are_refused(values: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError, match=said):
        SweepSettings(**values)


def test_the_folder_is_named_after_the_preset_where_none_is_given() -> None:
    assert SweepSettings(preset="paper").folder == Path("runs/sweep-paper")
    assert SweepSettings(out=Path("x")).folder == Path("x")


def test_what_varies_is_a_name_and_its_values() -> None:
    assert parse_varied("look-in-mirror=true, false,true") == Varied("look_in_mirror", ("true", "false"))
    for text in ("anneal", "anneal=", "=1", "anneal=1,,2"):
        with pytest.raises(ValueError, match="expected an option of training and its values"):
            parse_varied(text)
