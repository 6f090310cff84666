"""The frozen recipe: `test` opens with it alone, and nothing in it can change unseen."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from graspq.common.checksums import read_checked_json, write_checked_json
from graspq.common.errors import UserError
from graspq.studies.study.freezing import freeze, read_recipe, require_frozen

TEST = ("steps = 3", "steps = 3\nsplit = 'test'")


def test_the_test_split_opens_with_the_frozen_recipe_alone(plan: Callable[..., Any]) -> None:
    require_frozen(*plan())  # on validation all may be tried
    with pytest.raises(UserError, match=r"recipe.json is not there; .* grasp-study freeze tiny.toml"):
        require_frozen(*plan(TEST))
    freeze(*plan(TEST))
    require_frozen(*plan(TEST))
    with pytest.raises(UserError, match=r"mc-12: batch_size = 4 now, 8 in recipe.json"):
        require_frozen(*plan(TEST, ("batch_size = 8", "batch_size = 4")))
    with pytest.raises(UserError, match="freezes no row corr-mc-12"):
        require_frozen(*plan(TEST, ('"mc",', '"mc", "corr-mc",')))


def test_a_recipe_is_frozen_once(plan: Callable[..., Any]) -> None:
    assert freeze(*plan()) == freeze(*plan()) == Path("recipe.json")
    with pytest.raises(UserError, match="holds another recipe"):
        freeze(*plan(("steps = 3", "steps = 4")))


def test_a_recipe_that_was_edited_is_refused(plan: Callable[..., Any]) -> None:
    freeze(*plan())
    recipe = read_checked_json(Path("recipe.json"), "recipe", "")
    recipe["rows"]["mc-12"]["training"]["learning_rate"] = 1.0
    Path("recipe.json").write_text(Path("recipe.json").read_text().replace("code_revision", "core_revision"))
    with pytest.raises(UserError, match=r"checksum is not that of its content\); restore it"):
        read_recipe(Path("recipe.json"))
    write_checked_json(Path("recipe.json"), recipe)
    with pytest.raises(UserError, match="edited by hand"):
        read_recipe(Path("recipe.json"))
    Path("recipe.json").write_text("{}")
    with pytest.raises(UserError, match="not a frozen recipe"):
        read_recipe(Path("recipe.json"))
