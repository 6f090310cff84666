"""A trial: its name says what varies, its own files say how far it is, and its commands are what it still needs."""

import dataclasses
import json
import shutil
from typing import Any

import pytest

from graspq.studies.sweep.grid import trials_of
from graspq.studies.sweep.settings import SweepSettings
from graspq.studies.sweep.trial import Trial
from graspq.train.search_settings import CemSettings


def test_a_trials_name_says_what_varies_and_leaves_out_what_it_does_not_use(settings: SweepSettings) -> None:
    rate = ("learning_rate", "0.001")

    def name(*values: Any) -> str:
        return Trial(settings, *values).name

    assert name("dql", (rate, ("width", "32"), ("discount", "0.9")), 0) == "dql-lr0.001-width32-discount0.9-seed0"
    assert name("mc", (("exploration_steps", "10000"),), 8) == "mc-exploration10000-seed8"
    assert name("my_module:row", (rate, ("mirror", "true")), 1) == "my_module.row-lr0.001-mirrortrue-seed1"


def test_trials_that_differ_have_names_that_differ(settings: SweepSettings) -> None:
    trial = Trial(settings, "dql", (("learning_rate", "0.001"), ("width", "32")), 0)
    others = [dataclasses.replace(trial, algo="mc"), dataclasses.replace(trial, seed=1)]
    others += [dataclasses.replace(trial, options=(("learning_rate", "0.0010001"), ("width", "32")))]
    others += [dataclasses.replace(trial, options=(("learning_rate", "0.001"), ("width", "33")))]
    assert len({one.name for one in [trial, *others]}) == 5


def test_a_trial_is_read_as_it_was_written(trials: list[Trial], settings: SweepSettings) -> None:
    assert [Trial.from_json(settings, json.loads(json.dumps(one.to_json()))) for one in trials] == trials


def test_switches_are_turned_on_and_off(settings: SweepSettings) -> None:
    options = (("mirror", "true"), ("centred", "false"), ("preset", "default"))
    words = str(Trial(settings, "corr-mc", options, 0).training_command())
    assert "--preset default --mirror --no-centred" in words and "--preset paper" not in words


def test_on_policy_trials_train_in_the_papers_rounds() -> None:
    settings = SweepSettings(preset="paper", algo=("mc",), steps=7000, threads=3).complete()
    words = str(trials_of(settings)[0].training_command())
    assert words.startswith("grasp-online --algo mc --shards data/regular-100k --preset paper --learning-rate 0.01")
    assert "--exploration-steps 10000 " in words
    assert "--rounds 7 --steps-per-round 1000 --grasps 50 --workers 3" in words
    assert "--discount" not in words


def test_a_trial_trains_then_is_scored_then_needs_nothing(trials: list[Trial], write: Any) -> None:
    trial = trials[0]

    def following() -> str:
        return str(trial.next_command())

    assert following().startswith("grasp-train --algo dql --shards data --preset paper --learning-rate 0.01 --width 32")
    assert "--discount 0.9 --seed 0 --threads 2 --device cpu" in following() and "--steps 100" in following()
    write.trained(trial, 50)
    assert following().startswith("grasp-train ")
    write.trained(trial, 100)
    assert following() == (
        f"grasp-eval {trial.run_folder} --split validation --episodes 10 --seed 0 --workers 2 --device cpu"
    )
    write.scored(trial, 3)
    assert following() == "None"


def test_a_trial_is_done_when_its_last_step_is_scored_on_the_sweeps_scenes(trials: list[Trial], write: Any) -> None:
    trial = trials[0]
    assert (trial.state().status, trial.state().steps) == ("to do", 0)
    write.trained(trial, 50)
    write.scored(trial, 3, step=50)
    assert (trial.state().status, trial.state().steps) == ("to do", 50)
    write.trained(trial, 100)
    write.scored(trial, 4, episodes=20)
    assert trial.state().status == "to do"
    write.scored(trial, 4)
    state = trial.state()
    assert state.status == "done" and state.evaluation is not None and state.evaluation.summary["successes"] == 4
    assert trials[1].state().status == "to do"


@pytest.mark.parametrize("changed", [{"split": "train"}, {"seed": 1}, {"cem": {"samples": 2}}])
def test_an_evaluation_of_another_kind_does_not_count(changed: dict[str, Any], trials: list[Trial], write: Any) -> None:
    write.trained(trials[0], 100)
    write.scored(trials[0], 3, **changed)
    assert trials[0].state().status == "to do"


def test_a_score_counts_where_its_search_is_the_one_that_is_asked_for(trials: list[Trial], write: Any) -> None:
    asked = dataclasses.replace(trials[0], settings=dataclasses.replace(trials[0].settings, cem_views=1))
    write.trained(asked, 100)
    usual = write.scored(asked, 3)
    assert (trials[0].state().status, asked.state().status) == ("done", "to do")
    assert asked.evaluation_command().arguments[-2:] == ("--cem-views", "1")
    shutil.rmtree(usual)
    write.scored(asked, 4, cem=CemSettings(views=1).to_json())
    assert (trials[0].state().status, asked.state().status) == ("to do", "done")


def test_an_evaluation_with_damaged_rows_does_not_count(trials: list[Trial], write: Any) -> None:
    write.trained(trials[0], 100)
    place = write.scored(trials[0], 3)
    assert trials[0].state().status == "done"
    with (place / "episodes.jsonl").open("a") as file:
        file.write("{}\n")
    assert trials[0].state().status == "to do"


def test_a_failure_keeps_its_reason_until_the_job_is_done_all_the_same(trials: list[Trial], write: Any) -> None:
    trial = trials[0]
    trial.note_failure(command="grasp-train", exit_status=2, reason="dql diverged at step 7")
    state = trial.state()
    assert (state.status, state.reason) == ("failed", "dql diverged at step 7")
    write.trained(trial, 100)
    write.scored(trial, 3)
    assert (trial.state().status, trial.state().reason) == ("done", None)
    assert trial.failure_note.exists()


def test_a_run_that_is_deleted_takes_the_note_of_its_failure_with_it(trials: list[Trial], write: Any) -> None:
    trial = trials[0]
    write.trained(trial, 50)
    trial.note_failure(command="grasp-train", exit_status=2, reason="dql diverged at step 57")
    assert trial.state().status == "failed"
    shutil.rmtree(trial.run_folder)
    assert trial.state().status == "to do"


def test_training_seconds_are_those_of_the_steps_that_count(trials: list[Trial], write: Any) -> None:
    rows = (
        {"step": 50, "loss": 1.0, "samples_per_second": 100.0},
        {"step": 50, "validation": {"loss": 1.0}},
        {"step": 60, "loss": 1.0, "samples_per_second": 32.0},
    )
    write.trained(trials[0], 60, rows)
    assert trials[0].state().training_seconds == 50 * 32 / 100 + 10 * 32 / 32
    write.trained(trials[1], 60)
    assert trials[1].state().training_seconds is None
