"""The grids: the paper's is exactly the paper's, a settings' own lists replace theirs, and any option can vary."""

import itertools
from pathlib import Path

import pytest

from graspq.common.errors import UserError
from graspq.studies.sweep.grid import notes_on, trials_of
from graspq.studies.sweep.settings import SweepSettings, Varied
from graspq.studies.sweep.table import varied
from graspq.studies.sweep.trial import Options, Trial
from graspq.train.estimators import ESTIMATORS


def points(trials: list[Trial]) -> list[tuple[str, Options, int]]:
    return [(trial.algo, trial.options, trial.seed) for trial in trials]


def test_the_papers_plan_is_exactly_the_papers() -> None:
    settings = SweepSettings(preset="paper").complete()
    trials = trials_of(settings)
    expected = {
        (algo, (("learning_rate", rate), ("width", width), *discount, ("exploration_steps", "10000")), seed)
        for algo in ("supervised", "dql", "mc", "corr-mc", "ddpg", "pcl")
        for rate, width, seed in itertools.product(("0.01", "0.001", "0.0001"), ("32", "64"), range(9))
        for discount in (((),) if algo in ("supervised", "mc") else ((("discount", "0.9"),), (("discount", "0.95"),)))
    }
    assert len(trials) == len(expected) == 540
    assert set(points(trials)) == expected
    assert (settings.on_policy, settings.shards, settings.steps) == (True, ("data/regular-100k",), 2_000_000)


def test_the_papers_misprint_is_said_in_words_unless_durations_are_named() -> None:
    (note,) = (note for note in notes_on(SweepSettings(preset="paper")) if "exploration" in note.lower())
    assert "prints the two durations as 10000 and 10000" in note and "misprint" in note
    named = SweepSettings(preset="paper", exploration_steps=(10_000, 100_000), steps=3000, algo=("mc",))
    assert notes_on(named) == []
    assert {dict(trial.options)["exploration_steps"] for trial in trials_of(named.complete())} == {"10000", "100000"}


def test_the_small_plan_is_the_off_policy_grid_of_one_seed_for_every_estimator() -> None:
    settings = SweepSettings().complete()
    assert (settings.on_policy, settings.shards) == (False, ("data/regular-10k",))
    assert (settings.steps, settings.episodes, settings.workers) == (5_000, 200, 1)
    trials = trials_of(settings)
    assert list(dict.fromkeys(trial.algo for trial in trials)) == list(ESTIMATORS)
    assert {trial.seed for trial in trials} == {0}
    assert [len([trial for trial in trials if trial.algo == algo]) for algo in ("dql", "mc")] == [12, 6]


def point(rate: str, *discount: str) -> Options:
    return (("learning_rate", rate), ("width", "8"), *(("discount", value) for value in discount))


def test_lists_replace_the_grids_own_and_a_seeds_whole_grid_comes_before_the_next() -> None:
    settings = SweepSettings(algo=("mc", "dql", "mc"), learning_rate=(0.5,), width=(8,), discount=(0.5,), seeds=2)
    expected = [("mc", point("0.5"), 0), ("dql", point("0.5", "0.5"), 0)]
    expected += [("mc", point("0.5"), 1), ("dql", point("0.5", "0.5"), 1)]
    assert points(trials_of(settings.complete())) == expected


def small(*algo: str, **vary: tuple[str, ...]) -> SweepSettings:
    options = tuple(Varied(name, values) for name, values in vary.items())
    return SweepSettings(algo=algo, learning_rate=(0.5,), width=(8,), discount=(0.5,), vary=options)


def test_any_option_varies_where_an_estimator_has_it() -> None:
    trials = trials_of(small("corr-mc", "mc", anneal=("0.1", "1"), mirror=("true", "false")).complete())
    assert [trial.name for trial in trials] == [
        "corr-mc-lr0.5-width8-discount0.5-anneal0.1-mirrortrue-seed0",
        "corr-mc-lr0.5-width8-discount0.5-anneal0.1-mirrorfalse-seed0",
        "corr-mc-lr0.5-width8-discount0.5-anneal1-mirrortrue-seed0",
        "corr-mc-lr0.5-width8-discount0.5-anneal1-mirrorfalse-seed0",
        "mc-lr0.5-width8-mirrortrue-seed0",
        "mc-lr0.5-width8-mirrorfalse-seed0",
    ]
    assert varied([trial.state() for trial in trials]) == ("learning_rate", "width", "discount", "anneal", "mirror")


def test_an_option_of_the_networks_varies_with_those_networks_alone() -> None:
    trials = trials_of(small("mc", network=("paper", "default")).complete())
    assert [dict(trial.options).get("width") for trial in trials if dict(trial.options)["network"] == "paper"] == ["8"]
    assert len(trials) == 2


def test_an_estimator_of_ones_own_varies_in_its_own_option(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_row.py").write_text(OWN_ROW)
    monkeypatch.chdir(tmp_path)
    trials = trials_of(small("own_row:ROW", "mc", share=("0.25", "0.75")).complete())
    assert [trial.name for trial in trials] == [
        "own_row.ROW-lr0.5-width8-share0.25-seed0", "own_row.ROW-lr0.5-width8-share0.75-seed0", "mc-lr0.5-width8-seed0",
    ]  # fmt: skip


OWN_ROW = """
import dataclasses
from graspq.common.options import setting
from graspq.train.estimator import Estimator, RegressionSettings, TargetValue
from graspq.train.acting import StochasticSearch


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
        trials_of(settings.complete())
