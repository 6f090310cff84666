"""A plan in a file: rows that are multiplied out, and one line for every mistake."""

from pathlib import Path

import pytest

from graspq.common.errors import UserError
from graspq.studies.study.cells import cells_of
from graspq.studies.study.claims import FEWEST_TRAININGS, LEAST_FRESH
from graspq.studies.study.plan_file import read_plan

PLANS = Path(__file__).resolve().parents[3] / "studies" / "plans"


def test_lists_of_options_are_multiplied_out_and_name_their_rows(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(
        "sizes = ['10k']\noptions = {shift = 2}\n"
        "rows = ['mc', {algo = 'dql', learning_rate = [0.001, 1e-4], mirror = false},"
        " {algo = 'mc', name = 'long', steps = '8k'}]"
    )
    rows = read_plan(tmp_path / "a.toml").rows
    assert [(row.name, row.algo, row.steps) for row in rows] == [
        ("mc", "mc", None),
        ("dql-learningrate0.001-mirrorfalse", "dql", None),
        ("dql-learningrate0.0001-mirrorfalse", "dql", None),
        ("long", "mc", 8000),
    ]
    assert dict(rows[1].options) == {"preset": "default", "shift": "2", "learning_rate": "0.001", "mirror": "false"}


def test_a_row_with_the_papers_preset_has_the_papers_steps(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("sizes = ['10k']\nrows = [{algo = 'mc', preset = 'paper'}]")
    assert [row.steps for row in read_plan(tmp_path / "a.toml").rows] == [2_000_000]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("rows = ['mc'", "not a readable TOML file"),
        ("rows = ['mc']", "sizes is missing"),
        ("rows = ['mc']\nsizes = ['few']", "expected a whole number"),
        ("rows = ['mc']\nsizes = ['10k']\nsteps = 0", "steps = 0"),
        ("rows = ['mc']\nsizes = ['10k']\nepisodes = 1", "episodes = 1; expected a number of grasps"),
        ("rows = ['sarsa']\nsizes = ['10k']", "'sarsa' is unknown"),
        ("rows = [{n = 3}]\nsizes = ['10k']", "expected a list of estimators"),
        ("rows = ['mc', 'mc']\nsizes = ['10k']", "two rows are called 'mc'"),
        ("rows = [{algo = 'mc', name = 'a', shift = [1, 2]}]\nsizes = ['10k']", "would name 2 rows"),
        ("rows = [{algo = 'mc', seed = 1}]\nsizes = ['10k']", "seed: the study sets it"),
        ("rows = ['mc']\nsizes = ['10k']\nsetting = 'off'", "setting = 'off'; expected off-policy or on-policy"),
        ("rows = ['mc']\nsizes = ['10k']\nsplits = 'test'", "unknown key 'splits'"),
        ("rows = ['mc']\nsizes = ['10k']\npolicies = ['best']", "'best' is unknown"),
        ("rows = ['mc']\nsizes = ['10k']\ncem = {size = 3}", "unknown setting 'cem_size'"),
        ("rows = ['mc']\nsizes = ['10k']\ncem = {answer = 'first'}", "--cem-answer: 'first' is unknown"),
        ("rows = ['mc']\nsizes = ['10k']\ncem = {views = 'one'}", "cem_views: 'one' is no value of it"),
        ("rows = ['mc', 'dql']\nsizes = ['10k']\nreference = 'pcl'", "reference = 'pcl'; expected a row: mc, dql"),
    ],
)
def test_a_mistake_is_one_line_that_names_the_file(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(UserError) as caught:
        read_plan(tmp_path / "a.toml")
    assert said in caught.value.message and "a.toml" in caught.value.message and "\n" not in caught.value.message


@pytest.mark.parametrize("path", sorted(PLANS.glob("*.toml")), ids=lambda path: path.stem)
def test_the_plans_that_ship_have_rows_whose_options_there_are(path: Path) -> None:
    plan = read_plan(path)
    cells = [cell for cell in cells_of(plan, Path("study"), workers=1) if cell.seed == 0]
    assert len({cell.digest for cell in cells}) == len(plan.rows) * len(plan.sizes)


def test_a_name_is_one_recipe_over_all_plans_that_ship() -> None:
    digests: dict[tuple[str, ...], set[str]] = {}
    for path in PLANS.glob("*.toml"):
        plan = read_plan(path)
        for cell in cells_of(plan, Path("study"), workers=1):
            place = (cell.row, cell.task, cell.size, plan.values["setting"], plan.split)
            digests.setdefault(place, set()).add(cell.digest)
    assert [place for place, some in digests.items() if len(some) > 1] == []


def test_the_plan_of_fresh_grasps_asks_for_a_tenth_of_the_data_and_lets_exploration_fall_to_its_end() -> None:
    plan = read_plan(PLANS / "on-policy.toml")
    cell = cells_of(plan, Path("study"), workers=1)[0]
    rounds = cell.deciding["online"]
    fresh = rounds["rounds"] * rounds["grasps"]
    assert fresh / (fresh + 10_000) >= LEAST_FRESH
    assert rounds["exploration_steps"] <= (rounds["rounds"] - 1) * rounds["steps_per_round"]


def test_the_plan_of_stability_has_as_many_trainings_of_both_kinds_as_the_claim_asks_for() -> None:
    plan = read_plan(PLANS / "stability.toml")
    algos = [cell.algo for cell in cells_of(plan, Path("study"), workers=1)]
    assert all(algos.count(algo) >= FEWEST_TRAININGS for algo in ("ddpg", "dql", "mc"))
