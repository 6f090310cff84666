"""The grids: the paper's is exactly the paper's, a settings' own lists replace theirs, and any option can vary."""

import itertools
from pathlib import Path

import pytest

from graspq.common.errors import UserError
from graspq.studies.grid import make_plan
from graspq.studies.plan import Job
from graspq.studies.settings import SweepSettings, Varied
from graspq.train.estimators import ESTIMATORS


def test_the_papers_plan_is_exactly_the_papers() -> None:
    plan = make_plan(SweepSettings(preset="paper"))
    expected = {
        Job(
            algo,
            (("learning_rate", rate), ("width", width), *discount, ("exploration_steps", "10000")),
            seed,
        )
        for algo in ("supervised", "dql", "mc", "corr-mc", "ddpg", "pcl")
        for rate, width, seed in itertools.product(("0.01", "0.001", "0.0001"), ("32", "64"), range(9))
        for discount in (((),) if algo in ("supervised", "mc") else ((("discount", "0.9"),), (("discount", "0.95"),)))
    }
    assert len(plan.jobs) == len(expected) == 540
    assert set(plan.jobs) == expected
    assert (plan.on_policy, plan.shards, plan.steps) == (True, ("data/regular-100k",), 2_000_000)


def test_the_papers_misprint_is_said_in_words_unless_durations_are_named() -> None:
    (note,) = (note for note in make_plan(SweepSettings(preset="paper")).notes if "exploration" in note.lower())
    assert "prints the two durations as 10000 and 10000" in note and "misprint" in note
    named = make_plan(SweepSettings(preset="paper", exploration_steps=(10_000, 100_000), steps=3000, algo=("mc",)))
    assert named.notes == ()
    assert {dict(job.options)["exploration_steps"] for job in named.jobs} == {"10000", "100000"}


def test_the_small_plan_is_the_off_policy_grid_of_one_seed_for_every_estimator() -> None:
    plan = make_plan(SweepSettings())
    assert (plan.on_policy, plan.shards, plan.steps, plan.episodes) == (False, ("data/regular-10k",), 5_000, 200)
    assert list(dict.fromkeys(job.algo for job in plan.jobs)) == list(ESTIMATORS)
    assert {job.seed for job in plan.jobs} == {0}
    assert [len([job for job in plan.jobs if job.algo == algo]) for algo in ("dql", "mc")] == [12, 6]


def point(rate: str, *discount: str) -> tuple[tuple[str, str], ...]:
    return (("learning_rate", rate), ("width", "8"), *(("discount", value) for value in discount))


def test_lists_replace_the_grids_own_and_a_seeds_whole_grid_comes_before_the_next() -> None:
    settings = SweepSettings(algo=("mc", "dql", "mc"), learning_rate=(0.5,), width=(8,), discount=(0.5,), seeds=2)
    jobs = [Job("mc", point("0.5"), 0), Job("dql", point("0.5", "0.5"), 0)]
    jobs += [Job("mc", point("0.5"), 1), Job("dql", point("0.5", "0.5"), 1)]
    assert make_plan(settings).jobs == tuple(jobs)


def small(*algo: str, **vary: tuple[str, ...]) -> SweepSettings:
    varied = tuple(Varied(name, values) for name, values in vary.items())
    return SweepSettings(algo=algo, learning_rate=(0.5,), width=(8,), discount=(0.5,), vary=varied)


def test_any_option_varies_where_an_estimator_has_it() -> None:
    plan = make_plan(small("corr-mc", "mc", anneal=("0.1", "1"), mirror=("true", "false")))
    assert [job.id for job in plan.jobs] == [
        "corr-mc-lr0.5-width8-discount0.5-anneal0.1-mirrortrue-seed0",
        "corr-mc-lr0.5-width8-discount0.5-anneal0.1-mirrorfalse-seed0",
        "corr-mc-lr0.5-width8-discount0.5-anneal1-mirrortrue-seed0",
        "corr-mc-lr0.5-width8-discount0.5-anneal1-mirrorfalse-seed0",
        "mc-lr0.5-width8-mirrortrue-seed0",
        "mc-lr0.5-width8-mirrorfalse-seed0",
    ]
    assert plan.varied == ("learning_rate", "width", "discount", "anneal", "mirror")


def test_an_option_of_the_networks_varies_with_those_networks_alone() -> None:
    plan = make_plan(small("mc", network=("paper", "default")))
    assert [dict(job.options).get("width") for job in plan.jobs if dict(job.options)["network"] == "paper"] == ["8"]
    assert len(plan.jobs) == 2


def test_an_estimator_of_ones_own_varies_in_its_own_option(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_row.py").write_text(OWN_ROW)
    monkeypatch.chdir(tmp_path)
    plan = make_plan(small("own_row:ROW", "mc", share=("0.25", "0.75")))
    assert [job.id for job in plan.jobs] == [
        "own_row.ROW-lr0.5-width8-share0.25-seed0", "own_row.ROW-lr0.5-width8-share0.75-seed0", "mc-lr0.5-width8-seed0",
    ]  # fmt: skip


OWN_ROW = """
import dataclasses
from graspq.common.options import setting
from graspq.train.estimator import Estimator, RegressionSettings, TargetValue
from graspq.train.selection import StochasticSearch


@dataclasses.dataclass(frozen=True)
class Own(RegressionSettings):
    share: float = setting(0.5, help="Part of the return.", minimum=0, maximum=1)


ROW = Estimator(
    summary="Part of the return",
    settings=Own,
    target_value=TargetValue("part of the return", lambda batch, networks, own, random, progress: batch.mc_return),
    action_selection=StochasticSearch(),
    paper=Own(loss="squared"),
)
"""


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (SweepSettings(algo=("sarsa",)), "'sarsa' is unknown"),
        (SweepSettings(exploration_steps=(10,)), "never explores"),
        (SweepSettings(preset="paper", steps=1500), "expected a multiple of 1000"),
        (small("mc", "dql", anneal=("1",)), "--vary anneal: no option of training with mc, dql"),
    ],
)
def test_what_cannot_be_planned_is_refused(settings: SweepSettings, said: str) -> None:
    with pytest.raises(UserError, match=said):
        make_plan(settings)
