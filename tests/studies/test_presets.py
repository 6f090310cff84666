"""The grids: the paper's is exactly the paper's, and a settings' own lists replace theirs."""

import itertools

import pytest

from graspq.common.errors import UserError
from graspq.studies.plan import Job
from graspq.studies.presets import PAPER_USES_DISCOUNT, make_plan, uses_discount
from graspq.studies.settings import SweepSettings
from graspq.train.estimators import ESTIMATORS


def test_the_papers_plan_is_exactly_the_papers() -> None:
    plan = make_plan(SweepSettings(preset="paper"))
    expected = {
        Job(algo, rate, width, discount, 10_000, seed)
        for algo in ("supervised", "dql", "mc", "corr-mc", "ddpg", "pcl")
        for rate, width, seed in itertools.product((0.01, 0.001, 0.0001), (32, 64), range(9))
        for discount in ((None,) if algo in ("supervised", "mc") else (0.9, 0.95))
    }
    assert len(plan.jobs) == len(expected) == 540
    assert set(plan.jobs) == expected
    assert (plan.on_policy, plan.shards, plan.steps) == (True, ("data/regular-100k",), 2_000_000)


def test_the_papers_misprint_is_said_in_words_unless_durations_are_named() -> None:
    (note,) = (note for note in make_plan(SweepSettings(preset="paper")).notes if "exploration" in note.lower())
    assert "prints the two durations as 10000 and 10000" in note and "misprint" in note
    named = make_plan(SweepSettings(preset="paper", exploration_steps=(10_000, 100_000), steps=3000, algo=("mc",)))
    assert named.notes == ()
    assert {job.exploration_steps for job in named.jobs} == {10_000, 100_000}


def test_what_the_papers_plan_knows_of_discounts_is_what_the_table_of_estimators_says() -> None:
    known = {name: uses_discount(name, "small") for name in PAPER_USES_DISCOUNT if name in ESTIMATORS}
    assert known == {name: PAPER_USES_DISCOUNT[name] for name in known}
    assert {"dql", "mc"} <= known.keys()


def test_the_small_plan_is_the_off_policy_grid_of_one_seed_for_every_estimator() -> None:
    plan = make_plan(SweepSettings())
    assert (plan.on_policy, plan.shards, plan.steps, plan.episodes) == (False, ("data/regular-10k",), 5_000, 200)
    assert [job.algo for job in plan.jobs if job.learning_rate == 0.01 and job.width == 64] == [
        name for name in ESTIMATORS for _ in range(2 if uses_discount(name, "small") else 1)
    ]
    assert {(job.seed, job.exploration_steps) for job in plan.jobs} == {(0, None)}
    assert len([job for job in plan.jobs if job.algo == "dql"]) == 12


def test_lists_replace_the_grids_own_and_a_seeds_whole_grid_comes_before_the_next() -> None:
    settings = SweepSettings(algo=("mc", "dql", "mc"), learning_rate=(0.5,), width=(8,), discount=(0.5,), seeds=2)
    jobs = [Job("mc", 0.5, 8, None, None, 0), Job("dql", 0.5, 8, 0.5, None, 0)]
    jobs += [Job("mc", 0.5, 8, None, None, 1), Job("dql", 0.5, 8, 0.5, None, 1)]
    assert make_plan(settings).jobs == tuple(jobs)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (SweepSettings(algo=("sarsa",)), "'sarsa' is unknown"),
        (SweepSettings(exploration_steps=(10,)), "never explores"),
        (SweepSettings(preset="paper", steps=1500), "expected a multiple of 1000"),
    ],
)
def test_what_cannot_be_planned_is_refused(settings: SweepSettings, said: str) -> None:
    with pytest.raises(UserError, match=said):
        make_plan(settings)
