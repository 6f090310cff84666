"""How far a job is: its own files say so, and nothing else."""

from pathlib import Path
from typing import Any

import pytest

from graspq.studies.plan import Plan
from graspq.studies.state import failure_file, note_failure, state_of


def test_a_job_is_done_when_its_last_step_is_scored_on_the_plans_scenes(plan: Plan, tmp_path: Path, write: Any) -> None:
    job = plan.jobs[0]
    assert (state_of(tmp_path, plan, job).status, state_of(tmp_path, plan, job).steps) == ("to do", 0)
    write.trained(tmp_path, job, 50)
    write.scored(tmp_path, job, 3, step=50)
    assert (state_of(tmp_path, plan, job).status, state_of(tmp_path, plan, job).steps) == ("to do", 50)
    write.trained(tmp_path, job, 100)
    write.scored(tmp_path, job, 4, episodes=20)
    assert state_of(tmp_path, plan, job).status == "to do"
    write.scored(tmp_path, job, 4)
    state = state_of(tmp_path, plan, job)
    assert state.status == "done" and state.evaluation is not None and state.evaluation.summary["successes"] == 4
    assert state_of(tmp_path, plan, plan.jobs[1]).status == "to do"


@pytest.mark.parametrize("changed", [{"split": "train"}, {"seed": 1}, {"cem": {"samples": 2}}])
def test_an_evaluation_of_another_kind_does_not_count(
    changed: dict[str, Any], plan: Plan, tmp_path: Path, write: Any
) -> None:
    write.trained(tmp_path, plan.jobs[0], 100)
    write.scored(tmp_path, plan.jobs[0], 3, **changed)
    assert state_of(tmp_path, plan, plan.jobs[0]).status == "to do"


def test_an_evaluation_with_damaged_rows_does_not_count(plan: Plan, tmp_path: Path, write: Any) -> None:
    write.trained(tmp_path, plan.jobs[0], 100)
    place = write.scored(tmp_path, plan.jobs[0], 3)
    assert state_of(tmp_path, plan, plan.jobs[0]).status == "done"
    with (place / "episodes.jsonl").open("a") as file:
        file.write("{}\n")
    assert state_of(tmp_path, plan, plan.jobs[0]).status == "to do"


def test_a_failure_keeps_its_reason_until_the_job_is_done_all_the_same(plan: Plan, tmp_path: Path, write: Any) -> None:
    job = plan.jobs[0]
    note_failure(tmp_path, job, command="grasp-train", exit_status=2, reason="dql diverged at step 7")
    state = state_of(tmp_path, plan, job)
    assert (state.status, state.reason) == ("failed", "dql diverged at step 7")
    write.trained(tmp_path, job, 100)
    write.scored(tmp_path, job, 3)
    assert (state_of(tmp_path, plan, job).status, state_of(tmp_path, plan, job).reason) == ("done", None)
    assert failure_file(tmp_path, job).exists()


def test_training_seconds_are_those_of_the_steps_that_count(plan: Plan, tmp_path: Path, write: Any) -> None:
    rows = (
        {"step": 50, "loss": 1.0, "samples_per_second": 100.0},
        {"step": 50, "validation": {"loss": 1.0}},
        {"step": 60, "loss": 1.0, "samples_per_second": 32.0},
    )
    write.trained(tmp_path, plan.jobs[0], 60, rows)
    assert state_of(tmp_path, plan, plan.jobs[0]).training_seconds == 50 * 32 / 100 + 10 * 32 / 32
    write.trained(tmp_path, plan.jobs[1], 60)
    assert state_of(tmp_path, plan, plan.jobs[1]).training_seconds is None
