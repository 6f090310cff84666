"""Plans: names that stay, JSON and back, sweeps that grow."""

import dataclasses
from pathlib import Path

import pytest

from graspq.common.errors import UserError
from graspq.studies.plan import Job, Plan, joined, read_plan, write_plan


def test_a_jobs_name_says_what_varies_and_leaves_out_what_it_does_not_use() -> None:
    rate = ("learning_rate", "0.001")
    assert Job("dql", (rate, ("width", "32"), ("discount", "0.9")), 0).id == "dql-lr0.001-width32-discount0.9-seed0"
    assert Job("mc", (("exploration_steps", "10000"),), 8).id == "mc-exploration10000-seed8"
    assert Job("my_module:row", (rate, ("mirror", "true")), 1).id == "my_module.row-lr0.001-mirrortrue-seed1"


def test_jobs_that_differ_have_names_that_differ() -> None:
    job = Job("dql", (("learning_rate", "0.001"), ("width", "32")), 0)
    others = [dataclasses.replace(job, algo="mc"), dataclasses.replace(job, seed=1)]
    others += [dataclasses.replace(job, options=(("learning_rate", "0.0010001"), ("width", "32")))]
    others += [dataclasses.replace(job, options=(("learning_rate", "0.001"), ("width", "33")))]
    assert len({one.id for one in [job, *others]}) == 5


def test_a_plan_is_read_as_it_was_written(plan: Plan, tmp_path: Path) -> None:
    assert read_plan(tmp_path) is None
    write_plan(tmp_path, plan)
    assert read_plan(tmp_path) == plan


@pytest.mark.parametrize("text", ["{}", "[", '{"format_version": 2, "jobs": [{}]}'])
def test_a_file_that_is_no_plan_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "plan.json").write_text(text)
    with pytest.raises(UserError, match=r"plan\.json"):
        read_plan(tmp_path)


def test_a_sweep_takes_more_jobs_but_none_of_another_kind(plan: Plan, tmp_path: Path) -> None:
    first, second, third = plan.jobs
    older = dataclasses.replace(plan, jobs=(first, second))
    newer = dataclasses.replace(plan, jobs=(third, second), shards=("moved",))
    whole = joined(older, newer, tmp_path)
    assert (whole.jobs, whole.shards) == ((third, second, first), ("moved",))
    for change in ({"steps": 101}, {"episodes": 11}, {"split": "train"}, {"preset": "paper"}, {"on_policy": True}):
        with pytest.raises(UserError, match=f"holds a sweep with {next(iter(change))} = "):
            joined(older, dataclasses.replace(newer, **change), tmp_path)
