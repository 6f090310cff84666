"""Commands: what a job runs is what the commands understand, and what they do not is refused before anything runs."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from graspq.common.errors import UserError
from graspq.studies.commands import Means, check_commands, check_data, next_command, training_command
from graspq.studies.grid import make_plan
from graspq.studies.plan import Job, Plan
from graspq.studies.settings import SweepSettings
from graspq.studies.state import state_of
from graspq.train.estimators import ESTIMATORS


@pytest.mark.parametrize("preset", ["small", "paper"])
def test_the_commands_understand_every_job_of_every_estimator(preset: Any, tmp_path: Path) -> None:
    settings = SweepSettings(preset=preset, algo=tuple(ESTIMATORS), seeds=1, objects=tmp_path)
    plan = make_plan(settings)
    check_commands(tmp_path, plan, list(plan.jobs), Means(1, "cpu"))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ((("learning_rate", "fast"),), "'fast' is not a valid float"),
        ((("batch_size", "1"),), "--batch-size: expected a number of at least 2, got 1"),
        ((("mirror", "yes"),), "--vary mirror: is a switch, expected true or false, got 'yes'"),
    ],
)
def test_a_value_that_training_refuses_is_one_line_before_anything_runs(
    plan: Plan, tmp_path: Path, options: tuple[tuple[str, str], ...], said: str
) -> None:
    wrong = (Job("mc", options, 0),)
    with pytest.raises(UserError, match=said):
        check_commands(tmp_path, dataclasses.replace(plan, jobs=wrong), wrong, Means(1, "cpu"))


def test_switches_are_turned_on_and_off(plan: Plan, tmp_path: Path) -> None:
    job = Job("corr-mc", (("mirror", "true"), ("centred", "false"), ("preset", "default")), 0)
    words = str(training_command(tmp_path, plan, job, Means(1)))
    assert "--preset default --mirror --no-centred" in words and "--preset paper" not in words


def test_on_policy_jobs_train_in_the_papers_rounds(tmp_path: Path) -> None:
    plan = make_plan(SweepSettings(preset="paper", algo=("mc",), steps=7000))
    words = str(training_command(tmp_path, plan, plan.jobs[0], Means(3)))
    assert words.startswith("grasp-online --algo mc --shards data/regular-100k --preset paper --learning-rate 0.01")
    assert "--exploration-steps 10000 " in words
    assert "--rounds 7 --steps-per-round 1000 --grasps 50 --workers 3" in words
    assert "--discount" not in words


def test_a_job_trains_then_is_scored_then_needs_nothing(plan: Plan, tmp_path: Path, write: Any) -> None:
    job, means = plan.jobs[0], Means(2, "cpu")

    def following() -> str:
        return str(next_command(tmp_path, plan, state_of(tmp_path, plan, job), means))

    assert following().startswith("grasp-train --algo dql --shards data --preset paper --learning-rate 0.01 --width 32")
    assert "--discount 0.9 --seed 0 --threads 2 --device cpu" in following() and "--steps 100" in following()
    write.trained(tmp_path, job, 50)
    assert following().startswith("grasp-train ")
    write.trained(tmp_path, job, 100)
    assert following() == (
        f"grasp-eval {tmp_path}/runs/{job.id} --split test --episodes 10 --seed 0 --workers 2 --device cpu"
    )
    write.scored(tmp_path, job, 3)
    assert following() == "None"


def test_data_and_scenes_that_are_not_there_are_refused(plan: Plan, dataset: Path, tmp_path: Path, write: Any) -> None:
    here = dataclasses.replace(plan, shards=(str(dataset),))
    check_data(tmp_path, here)
    with pytest.raises(UserError, match="absent"):
        check_data(tmp_path, dataclasses.replace(plan, shards=(str(tmp_path / "absent"),)))
    with pytest.raises(UserError, match="split 'validation'"):
        check_data(tmp_path, dataclasses.replace(here, split="validation"))
    with pytest.raises(UserError, match="no object set"):
        check_data(tmp_path, dataclasses.replace(here, objects=str(tmp_path)))
    write.trained(tmp_path, plan.jobs[0], 50)
    with pytest.raises(UserError, match="learned from other data"):
        check_data(tmp_path, here)
