"""Settings: the paper's numbers, options that win over a preset, and what is refused."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from graspq.common.errors import UserError
from graspq.train.estimators import ESTIMATORS
from graspq.train.recipe import Recipe
from graspq.train.settings import Preset, TrainSettings, complete

# What the paper's released code gives (C), and where there is no code its text (P).
COMMON = {
    "network": "paper",  # C: cnn_ia_v1; P, figure 3
    "batch_size": 32,  # C: get_data
    "learning_rate": 1e-3,  # C
    "weight_decay": 0.0,  # C: Adam, no L2
    "schedule": "constant",  # C
    "warmup": 0.0,
    "average_decay": 0.0,
    "shift": 0,  # C: no augmentation
    "mirror": False,
    "color": 0.0,
    "last_step_weight": 1,
    "steps": 2_000_000,  # C: env_procedural
    "precision": "float32",
}
HUBER: dict[str, Any] = {"loss": "huber"}  # C; P, equations: squared
DOUBLE_Q = HUBER | {"discount": 0.9, "lag_steps": 50}  # P: every 50 gradient updates
# C: V by double Q over 16 actions; no clamp, no centring.
CORRECTED = HUBER | {
    "discount": 0.9,
    "candidates": 16,
    "clamped": False,
    "centred": False,
    "look_in_mirror": False,
}
OWN: dict[str, dict[str, Any]] = {
    "supervised": HUBER | {"use_pose": False},
    "dql": DOUBLE_Q | {"candidates": 16},  # P: 16 actions uniformly at random
    "mc": HUBER | {"discount": None},  # P, footnote; C
    # C: 100,000 of 2 million steps; the advantage's Q is the trained network's, gradient and all; 32 episodes.
    "corr-mc": CORRECTED | {"lag_steps": 100, "anneal": 0.05, "judge": "online-gradient", "batch_of": "episodes"},
    "ddpg": DOUBLE_Q | {"discount": 1.0, "actor_rest": 0.0, "actor_rate": 1.0, "actor_every": 1},
    # Not the paper's: the loss of the code they were published with, and else their defaults.
    "nstep": DOUBLE_Q | {"candidates": 16, "n": 2},
    "td-lambda": DOUBLE_Q | {"candidates": 16, "trace_decay": 0.5},
    "mc-floor": DOUBLE_Q | {"discount": 0.8, "candidates": 16},
    "iql": DOUBLE_Q | {"loss": "squared", "expectile": 0.9, "policy": "search", "sharpness": 10.0},
    "td3-bc": DOUBLE_Q | {"loss": "squared", "alpha": 2.5, "smoothing": 0.2, "smoothing_bound": 0.5, "actor_every": 2},
    # Configuration of the authors' Trust-PCL for grasping.
    "pcl": {
        "discount": 0.95,
        "lag_steps": 50,
        "actor_rate": 1.0,
        "path_steps": 10,
        "penalty": 3.0,
        "kl_bound": 0.02,
        "batch_of": "episodes",
    },
    "blend": CORRECTED | {"lag_steps": 50, "judge": "lagged"},  # not the paper's: as its parents
}
RECIPES: dict[str, dict[str, Any]] = {
    "corr-mc": {"learning_rate": 1e-4},
    "pcl": {"learning_rate": 1e-4, "batch_size": 64},
}


def given(preset: Preset = "default", **options: Any) -> TrainSettings:
    return complete({"algo": "dql", "shards": ("data",)} | options, preset)


@pytest.mark.parametrize("algo", ESTIMATORS)
def test_the_paper_preset_has_the_papers_values_for_every_estimator(algo: str) -> None:
    settings = given("paper", algo=algo)
    recipe = {field.name: getattr(settings, field.name) for field in dataclasses.fields(Recipe)}
    assert recipe == COMMON | RECIPES.get(algo, {})
    assert settings.own.to_json() == OWN[algo]
    assert settings.network_own.to_json() == {"width": 32}


@pytest.mark.parametrize("algo", ESTIMATORS)
def test_the_default_recipe_is_one_for_all_estimators_but_for_a_tuned_learning_rate(algo: str) -> None:
    settings, tuned = given(algo=algo), {"corr-mc": 1e-3, "pcl": 1e-3, "td3-bc": 1e-3}
    expected = {field.name: field.default for field in dataclasses.fields(Recipe)}
    expected["learning_rate"] = tuned.get(algo, expected["learning_rate"])
    assert {name: getattr(settings, name) for name in expected} == expected
    assert settings.own == ESTIMATORS[algo].settings()


def test_options_that_are_given_win_over_the_preset_even_when_they_are_its_opposite_or_zero() -> None:
    settings = given("paper", batch_size=64, mirror=True, weight_decay=0.5, network="default", loss="cross-entropy")
    assert (settings.batch_size, settings.mirror, settings.weight_decay) == (64, True, 0.5)
    assert settings.network == "default" and settings.own.to_json()["loss"] == "cross-entropy"
    assert (given(shift=0).shift, given(mirror=False).mirror) == (0, False)
    chosen = given("paper", algo="pcl", discount=0.9, learning_rate=0.01, batch_size=32, lag_steps=7)
    own = chosen.own.to_json()
    assert (own["discount"], chosen.learning_rate, chosen.batch_size, own["lag_steps"]) == (0.9, 0.01, 32, 7)


def test_steps_that_are_not_given_follow_the_number_of_grasps_and_the_batch_size() -> None:
    steps = [given().for_grasps(count).last_step for count in (10, 2_000, 10_000, 80_000)]
    assert steps == [10, 340, 1_000, 4_000]  # 8 times the grasps: 4 times the steps
    assert given(batch_size=128).for_grasps(10_000).last_step == 2_000
    assert given(steps=7).for_grasps(10_000).last_step == 7
    with pytest.raises(ValueError, match="for_grasps"):
        _ = given().last_step


def test_none_that_is_given_wins_over_the_preset_too() -> None:
    own = given("paper", algo="pcl", penalty=None, path_steps=None).own.to_json()
    assert own["penalty"] is None and own["path_steps"] is None
    own = given("paper", algo="pcl", penalty=None).own.to_json()
    assert own["penalty"] is None and own["path_steps"] == 10


def test_settings_survive_json() -> None:
    for algo in ESTIMATORS:
        settings = given("paper", algo=algo, shards=("a", "b"), out=Path("runs/x"), width=16)
        assert TrainSettings.from_json(settings.to_json()) == settings


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"algo": "sarsa"}, "'sarsa' is unknown; choose from supervised, dql, mc"),
        ({"batch_size": 1}, "--batch-size: expected a number of at least 2 and at most 1e.06, got 1"),
        ({"network": "resnet"}, "'resnet' is unknown"),
        ({"loss": "hinge"}, "'hinge' is unknown"),
        ({"discount": 1.5}, "--discount"),
        ({"average_decay": 1.0}, "--average-decay"),
        ({"shards": ()}, "--shards"),
        ({"anneal": 0.5}, "--anneal belongs to --algo corr-mc; it is no option of --algo dql with --network default"),
        ({"width": 8}, "--width belongs to --network paper; it is no option of --algo dql with --network default"),
        ({"speed": 1}, "No such option: --speed .with --algo dql and --network default."),
        ({"algo": "supervised", "discount": 1.0}, "--discount belongs to .*; it is no option of --algo supervised"),
    ],
)
def test_values_out_of_range_and_options_of_others_are_refused(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(UserError, match=message):
        given(**wrong)


def test_an_estimator_must_be_named() -> None:
    with pytest.raises(UserError, match=r"--algo: expected an estimator: supervised, dql, mc, .* or module:row"):
        complete({"shards": ("data",)})


@pytest.mark.parametrize(
    ("shards", "name"),
    [
        (("data/regular-10k",), "mc-regular-10k-seed0"),
        (("data/regular-10k/",), "mc-regular-10k-seed0"),
        (("data/regular-10k/shards/blocks-000000-000049.parquet",), "mc-regular-10k-seed0"),
        (("data/regular-*",), "mc-regular-seed0"),
    ],
)
def test_the_default_run_folder_names_estimator_dataset_and_seed(shards: tuple[str, ...], name: str) -> None:
    assert given(algo="mc", shards=shards).run_folder == Path("runs") / name


def test_discounts_are_the_estimators_own_the_datasets_or_those_given() -> None:
    def chosen(algo: str, stored: float, **options: Any) -> float:
        return given(algo=algo, **options).own.chosen_discount(stored)

    assert (chosen("dql", 1.0), chosen("corr-mc", 1.0)) == (0.9, 0.8)
    assert chosen("dql", 1.0, discount=0.0) == 0.0
    assert (chosen("mc", 1.0), chosen("mc", 0.95), chosen("mc", 1.0, discount=0.0)) == (1.0, 0.95, 0.0)
    assert chosen("supervised", 0.95) == 1.0
