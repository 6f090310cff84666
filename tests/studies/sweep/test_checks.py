"""What is checked before a sweep: commands understand every trial, and data and scenes are there."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from graspq.common.errors import UserError
from graspq.studies.sweep.checks import check_commands, check_data
from graspq.studies.sweep.grid import trials_of
from graspq.studies.sweep.settings import SweepSettings
from graspq.studies.sweep.trial import Options, Trial
from graspq.train.estimators import ESTIMATORS


@pytest.mark.parametrize("preset", ["small", "paper"])
def test_the_commands_understand_every_trial_of_every_estimator(preset: Any, tmp_path: Path) -> None:
    settings = SweepSettings(preset=preset, algo=tuple(ESTIMATORS), seeds=1, objects=tmp_path, out=tmp_path)
    check_commands(trials_of(settings.complete()))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ((("learning_rate", "fast"),), "'fast' is not a valid float"),
        ((("batch_size", "1"),), "--batch-size: expected a number of at least 2 and at most"),
        ((("mirror", "yes"),), "--vary mirror: is a switch, expected true or false, got 'yes'"),
    ],
)
def test_a_value_that_training_refuses_is_one_line_before_anything_runs(
    settings: SweepSettings, options: Options, said: str
) -> None:
    with pytest.raises(UserError, match=said):
        check_commands([Trial(settings, "mc", options, 0)])


def test_data_and_scenes_that_are_not_there_are_refused(
    settings: SweepSettings, trials: list[Trial], dataset: Path, tmp_path: Path, write: Any
) -> None:
    here = dataclasses.replace(settings, shards=(str(dataset),))
    check_data(here, trials)
    with pytest.raises(UserError, match="absent"):
        check_data(dataclasses.replace(settings, shards=(str(tmp_path / "absent"),)), trials)
    with pytest.raises(UserError, match="split 'test-clutter'"):
        check_data(dataclasses.replace(here, split="test-clutter"), trials)
    with pytest.raises(UserError, match="no object set"):
        check_data(dataclasses.replace(here, objects=tmp_path), trials)
    write.trained(trials[0], 50)
    with pytest.raises(UserError, match="learned from other data"):
        check_data(here, trials)
