"""Cells: their order, and what of their settings is a recipe."""

from collections.abc import Callable
from typing import Any

import pytest

from graspq.common.errors import UserError


def test_seeds_are_done_one_after_the_other_and_the_longest_of_a_seed_first(plan: Callable[..., Any]) -> None:
    _, cells = plan(('"mc",', '"mc", {algo = "mc", name = "long", steps = 9},'))
    assert [cell.name for cell in cells[:4]] == [
        "long-regular-12-seed0",
        "mc-regular-12-seed0",
        "dql-width4-regular-12-seed0",
        "dql-width5-regular-12-seed0",
    ]
    assert [cell.seed for cell in cells] == [0] * 4 + [1] * 4


def test_the_digest_of_a_row_is_that_of_what_is_learned_not_of_seed_threads_or_folder(plan: Callable[..., Any]) -> None:
    _, cells = plan()
    _, others = plan(("steps = 3", "threads = 2\nsteps = 3"), data="elsewhere")
    assert len({cell.digest for cell in cells}) == 3
    assert [cell.digest for cell in cells] == [cell.digest for cell in others]
    _, longer = plan(("steps = 3", "steps = 4"))
    assert {cell.digest for cell in cells}.isdisjoint(cell.digest for cell in longer)


def test_an_on_policy_cell_trains_in_rounds_and_its_recipe_holds_them(plan: Callable[..., Any]) -> None:
    _, (cell, *_) = plan(("steps = 3", "steps = 2000\nsetting = 'on-policy'"))
    assert cell.training_command().script == "grasp-online"
    assert cell.deciding["online"]["rounds"] == 2 and cell.deciding["training"]["steps"] == 2000


def test_the_search_of_a_plan_is_that_of_its_scores_and_part_of_the_recipe(plan: Callable[..., Any]) -> None:
    _, (usual, *_) = plan()
    _, (other, *_) = plan(("steps = 3", "steps = 3\ncem = {answer = 'last', views = 1}"))
    words = other.evaluation_command().arguments
    assert (
        words[-4:] == ("--cem-answer", "last", "--cem-views", "1")
        and "--cem-answer" not in other.training_command().arguments
    )
    assert "--cem-answer" not in usual.evaluation_command().arguments
    assert usual.digest != other.digest and other.deciding["search"]["views"] == 1
    _, (online, *_) = plan(("steps = 3", "steps = 2000\nsetting = 'on-policy'\ncem = {views = 1}"))
    assert online.training_command().arguments[-2:] == ("--cem-views", "1")
    assert online.deciding["search"]["views"] == online.deciding["online"]["cem_views"] == 1


def test_an_option_that_a_row_does_not_have_is_refused_by_name(plan: Callable[..., Any]) -> None:
    _, (cell, *_) = plan(('"mc",', '{algo = "mc", nu = 1},'))
    with pytest.raises(UserError, match=r"^\S*\.toml, row mc-nu1: no option nu of training with mc"):
        cell.training_command()
    _, (cell, *_) = plan(('"mc",', '{algo = "mc", learning_rate = "fast"},'))
    with pytest.raises(UserError, match=r"^\S*\.toml, row mc-learningratefast: .*'fast' is not a valid float"):
        _ = cell.digest
