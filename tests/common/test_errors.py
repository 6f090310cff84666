"""What a user is told of a folder that was made otherwise."""

from pathlib import Path

import pytest

from graspq.common.errors import UserError, refuse_other


def test_the_setting_that_differs_is_named_with_its_place(tmp_path: Path) -> None:
    refuse_other(tmp_path, "data", {"a": {"b": 1}}, {"a": {"b": 1}}, "go")
    with pytest.raises(UserError, match=r"holds data with a\.b\.c = 1, not None; go"):
        refuse_other(tmp_path, "data", {"a": {"b": {"c": 1}}}, {"a": {"b": {}}}, "go")
