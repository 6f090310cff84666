"""What a study shows: one section of a page, written anew in its place, and figures."""

from pathlib import Path

import matplotlib.image
import pytest

from graspq.common.errors import UserError
from graspq.studies.study.comparisons import scored_rows
from graspq.studies.study.publishing import choosing_table, publish, section, with_section
from graspq.studies.study.scores import read_scores
from tests.studies.study.scored_studies import runs, study

PLAN = Path("plans/s.toml")


def test_a_study_gets_a_section_of_its_own_that_takes_the_place_of_the_older_one(tmp_path: Path) -> None:
    page, results = tmp_path / "RESULTS.md", tmp_path / "results"
    page.write_text("# Results\n\nOurs.\n")
    table = study(dql=0.9, mc=0.7, ddpg=0.5) + runs("pcl", 0.5, seeds=1, status="failed", reason="diverged")
    for _ in range(2):
        written = publish("s", PLAN, table, [], results, page)
    assert sorted(path.relative_to(tmp_path).as_posix() for path in written) == [
        "RESULTS.md", "results/figures/study-s.png", "results/study-s.jsonl",
    ]  # fmt: skip
    text = page.read_text()
    assert text.startswith("# Results\n\nOurs.\n") and text.count("## Study s") == 1
    lines = text.splitlines()
    (best,) = [line for line in lines if line.startswith("| `dql`")]
    (other,) = [line for line in lines if line.startswith("| `mc`")]
    assert lines.index(best) < lines.index(other) and "| < 0.001 | 0.9 | 100 | `cccccccc` |" in other
    assert (
        "9 of 10 trainings, of a frozen recipe, scored on `test`" in text
        and "`pcl` (regular, 10k, off-policy, test): 1 of 1 trainings failed; seed 0: diverged" in text
    )
    assert text.count("| **not tested** |") >= 2
    assert "](results/study-s.jsonl)" in text and matplotlib.image.imread(results / "figures/study-s.png").size
    assert read_scores([results / "study-s.jsonl"]) == table


def test_a_row_says_itself_how_many_of_its_trainings_failed(tmp_path: Path) -> None:
    table = study(dql=0.9, ddpg=0.5) + runs("ddpg", 0.5, seeds=1, seed=3, status="failed", reason="diverged")
    publish("s", PLAN, table + runs("pcl", 0.5, status="to do"), [], tmp_path, tmp_path / "RESULTS.md")
    text = (tmp_path / "RESULTS.md").read_text()
    assert "| `ddpg` (1 of 4 trainings failed) |" in text and "| `dql` |" in text and "Not run: `pcl`." in text


def test_measures_that_choose_without_a_simulator_are_ranked_by_their_sign_within_a_place_and_an_estimator() -> None:
    table = study(dql=0.9, mc=0.5) + runs("dql", 0.9, size="1k")
    lines = choosing_table(scored_rows(table)).splitlines()[2:]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert [line[:3] + line[4:] for line in cells] == [
        ["held-back loss", "regular, 10k, off-policy, test", "+1.00", "6"],
        ["OPC", "regular, 10k, off-policy, test", "-1.00", "6"],
        ["held-back loss", "regular, 1k, off-policy, test", "+1.00", "3"],
        ["OPC", "regular, 1k, off-policy, test", "-1.00", "3"],
    ]


def test_the_papers_settings_with_unequal_steps_are_tested_against_nothing() -> None:
    paper = {"options": {"preset": "paper"}}
    rows = [*runs("dql", 0.9, **paper), *runs("mc", 0.7, **paper)]
    equal = section("s", PLAN, rows, [], [Path("s.jsonl")])
    assert "| < 0.001 |" in equal and "The claims of the paper" in equal
    for row in rows[3:]:
        row["steps"] = 10
    unequal = section("s", PLAN, rows, [], [Path("s.jsonl")])
    assert "| < 0.001 |" not in unequal and "The claims of the paper" not in unequal
    assert "unequal numbers of steps" in unequal


def test_differences_are_to_the_row_that_the_plan_names() -> None:
    text = section("s", PLAN, study(dql=0.9, mc=0.7), [], [Path("s.jsonl")], "mc")
    assert "| less mc |" in text and "| dql |" not in text
    (line,) = [line for line in text.splitlines() if line.startswith("| `dql`")]
    assert "+0.1" in line or "+0.2" in line


@pytest.mark.parametrize(
    ("seeds", "over"),
    [
        ((3, 3), "over new training seeds, scenes and objects;"),
        ((3, 1), "over new training seeds, scenes and objects (of a row with one training: for that one);"),
        ((1, 1), "over new scenes and objects, for the one training of each row;"),
    ],
)
def test_intervals_are_said_to_hold_for_new_trainings_where_there_are_several(
    seeds: tuple[int, int], over: str
) -> None:
    table = [*runs("dql", 0.9, seeds=seeds[0]), *runs("mc", 0.7, seeds=seeds[1])]
    assert f"Intervals are 95 %, {over}" in section("s", PLAN, table, [], [Path("s.jsonl")])


def test_scores_of_validation_are_named_as_those_that_were_chosen_on(tmp_path: Path) -> None:
    table = [row | {"split": "validation", "recipe_frozen": False} for row in study(dql=0.9)]
    publish("s", PLAN, table, [], tmp_path, tmp_path / "RESULTS.md")
    text = (tmp_path / "RESULTS.md").read_text()
    assert "not frozen, scored on `validation`. Choices are made on such scores" in text


def test_success_over_an_option_and_sorted_settings_are_drawn_where_rows_vary(tmp_path: Path) -> None:
    table = study(mc=0.7)
    for n in ("1", "3", "15"):
        table += runs(f"nstep-n{n}", 0.8, algo="nstep", options={"preset": "default", "n": n})
    names = {path.name for path in publish("s", PLAN, table, [], tmp_path, None)}
    assert {"study-s-over.png", "study-s-sorted.png"} <= names


def test_a_study_without_a_score_is_refused_and_so_is_what_is_no_study(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no run is scored yet"):
        publish("s", PLAN, runs("mc", 0.5, status="to do"), [], tmp_path, None)
    for text in ("", "{}", "["):
        (tmp_path / "a.jsonl").write_text(text)
        with pytest.raises(UserError, match=r"not the scores of a study|not a readable table of grasp-study run"):
            read_scores([tmp_path / "a.jsonl"])


def test_scores_that_are_no_rows_beside_these_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    beside = runs("dql", 0.7, recipe_sha256="e" * 64, study="paper")
    with pytest.raises(UserError, match="2 recipes"):
        publish("s", PLAN, study(dql=0.9), beside, tmp_path, tmp_path / "RESULTS.md")
    assert list(tmp_path.iterdir()) == []


def test_sections_of_two_studies_live_side_by_side() -> None:
    page = with_section(with_section("A\n", "one", "1"), "two", "2")
    assert with_section(page, "one", "3") == page.replace("\n1\n", "\n3\n")
