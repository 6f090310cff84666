"""Presets: the paper's numbers, and options that win over them."""

from pathlib import Path

import pytest

from graspq.common.errors import UserError
from graspq.train.settings import PRESETS, TrainOptions, TrainSettings, preset_settings, resolve


def given(**options: object) -> TrainSettings:
    return resolve(TrainOptions(**{"algo": "dql", "shards": ("data",)} | options))


def test_the_paper_preset_has_the_papers_settings() -> None:
    settings = given(preset="paper")
    assert settings.network == "paper"
    assert settings.loss == "squared"
    assert settings.batch_size == 32
    assert settings.learning_rate == 1e-3
    assert settings.weight_decay == 0.0, "Adam"
    assert settings.schedule == "constant" and settings.warmup == 0.0
    assert settings.average_decay == 0.0
    assert (settings.shift, settings.mirror, settings.jitter) == (0, False, 0.0), "no augmentation"
    assert settings.lag_steps == 50
    assert settings.candidates == 16
    assert settings.steps == 2_000_000
    assert (settings.anneal, settings.centred) == (0.05, False), "100,000 of 2 million steps"
    assert (settings.actor_rest, settings.actor_rate, settings.actor_every) == (0.0, 1.0, 1)
    assert (settings.path_steps, settings.penalty, settings.precision) == (10, 3.0, "float32")


def test_the_paper_preset_has_what_the_authors_code_has_for_one_estimator_alone() -> None:
    corrected, paths = given(algo="corr-mc", preset="paper"), given(algo="pcl", preset="paper")
    assert (corrected.learning_rate, corrected.lag_steps, corrected.batch_size) == (1e-4, 100, 32)
    assert (paths.learning_rate, paths.lag_steps, paths.batch_size, paths.discount) == (1e-4, 50, 64, 0.95)
    assert preset_settings("paper", algo="pcl", shards=("data",)) == paths
    chosen = given(algo="pcl", preset="paper", discount=0.9, learning_rate=0.01, batch_size=32, lag_steps=7)
    assert (chosen.discount, chosen.learning_rate, chosen.batch_size, chosen.lag_steps) == (0.9, 0.01, 32, 7)
    assert given(algo="pcl").learning_rate == given(algo="dql").learning_rate


def test_options_that_are_given_win_over_the_preset_even_when_they_are_its_opposite_or_zero() -> None:
    settings = given(preset="paper", batch_size=64, mirror=True, weight_decay=0.5, network="default")
    assert (settings.batch_size, settings.mirror, settings.weight_decay) == (64, True, 0.5)
    assert settings.network == "default" and settings.loss == "squared"
    assert given(preset="default", shift=0, mirror=False).shift == 0
    assert given(preset="default", mirror=False).mirror is False


def test_without_a_preset_the_default_one_decides_and_equals_plain_settings() -> None:
    assert (
        given()
        == TrainSettings(algo="dql", shards=("data",))
        == preset_settings("default", algo="dql", shards=("data",))
    )


def test_both_presets_govern_the_same_settings() -> None:
    assert PRESETS["default"].keys() == PRESETS["paper"].keys()


def test_settings_survive_json() -> None:
    settings = preset_settings("paper", algo="mc", shards=("a", "b"), out=Path("runs/x"), discount=1.0)
    assert TrainSettings.from_json(settings.to_json()) == settings


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"algo": "sarsa"}, "'sarsa' is unknown; choose from supervised, dql, mc"),
        ({"batch_size": 1}, "--batch-size: expected a number of at least 2, got 1"),
        ({"network": "resnet"}, "'resnet' is unknown"),
        ({"loss": "hinge"}, "'hinge' is unknown"),
        ({"discount": 1.5}, "--discount"),
        ({"average_decay": 1.0}, "--average-decay"),
        ({"shards": ()}, "--shards"),
    ],
)
def test_values_out_of_range_are_refused(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(UserError, match=message):
        given(**wrong)


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
    assert TrainSettings(algo="mc", shards=shards).run_folder == Path("runs") / name
