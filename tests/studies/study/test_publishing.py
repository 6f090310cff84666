"""What a study shows: one section of a page, written anew in its place, and figures."""

import re
from pathlib import Path
from typing import Any

import matplotlib.image
import pytest

from graspq.common.errors import UserError
from graspq.evaluate.statistics import mean_success, object_counts
from graspq.studies.study.comparisons import scored_rows
from graspq.studies.study.publishing import choosing_table, publish, section, with_section
from graspq.studies.study.scores import read_scores
from tests.studies.study.scored_studies import outcomes, runs, scenes, study

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
        ["held-back loss", "regular, 10k, off-policy, test", "+1.00", "±0.88", "6"],
        ["OPC", "regular, 10k, off-policy, test", "-1.00", "±0.88", "6"],
        ["held-back loss", "regular, 1k, off-policy, test", "+1.00", "±1.00", "3"],
        ["OPC", "regular, 1k, off-policy, test", "-1.00", "±1.00", "3"],
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
        ((3, 3), "new training seeds, scenes and objects with this one dataset;"),
        (
            (3, 1),
            "new training seeds, scenes and objects with this one dataset (of a row with one training: for that one",
        ),
        ((1, 1), "new scenes and objects, for the one training of each row (another may lie as far off again);"),
    ],
)
def test_intervals_are_said_to_hold_for_new_trainings_where_there_are_several(
    seeds: tuple[int, int], over: str
) -> None:
    table = [scenes(), *runs("dql", 0.9, seeds=seeds[0]), *runs("mc", 0.7, seeds=seeds[1])]
    assert f"Intervals are 95 %, over {over}" in section("s", PLAN, table, [], [Path("s.jsonl")])


def test_intervals_speak_of_these_objects_alone_where_nobody_knows_which_lay_where() -> None:
    text = section("s", PLAN, runs("dql", 0.9), [], [Path("s.jsonl")])
    assert "over new training seeds, scenes of these objects with this one dataset;" in text


def row_of(name: str, table: list[dict[str, Any]]) -> list[str]:
    """Return the cells of a row of the table: its name, then success, interval, seeds, difference and p."""
    text = section("s", PLAN, table, [], [Path("s.jsonl")])
    (line,) = [line for line in text.splitlines() if line.startswith(f"| {name} ")]
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    return [cells[0], *cells[3:8]]


def test_a_single_training_is_told_apart_from_nothing_and_an_unfinished_row_is_not_tested() -> None:
    best = study(dql=0.9)
    assert re.fullmatch(r"-0\.\d{3}", row_of("`mc`", best + runs("mc", 0.7, seeds=1))[4])
    assert row_of("`mc`", best + runs("mc", 0.7, seeds=1))[5] == ""
    begun = best + runs("mc", 0.7) + runs("mc", 0.7, seeds=1, seed=3, status="to do")
    assert "(-0." in row_of("`mc`", begun)[4] and row_of("`mc`", begun)[5] == ""
    assert row_of("`mc`", best + runs("mc", 0.7))[5] == "< 0.001"


def test_a_row_of_which_trainings_failed_is_no_best_and_stands_last() -> None:
    table = study(dql=0.8, mc=0.7, ddpg=0.95) + runs("ddpg", 0.0, seeds=1, seed=3, status="failed", reason="diverged")
    text = section("s", PLAN, table, [], [Path("s.jsonl")])
    names = [line.split("|")[1].strip() for line in text.splitlines() if line.startswith("| `")]
    assert names[:3] == ["`dql`", "`mc`", "`ddpg` (1 of 4 trainings failed)"]
    assert row_of("`dql`", table)[4:] == ["", ""] and row_of("`mc`", table)[4].startswith("-0.0")
    assert row_of("`ddpg`", table)[4].startswith("+0.1") and row_of("`ddpg`", table)[5] == ""


def test_random_and_oracle_have_the_same_kind_of_interval_as_the_rows() -> None:
    table = study(dql=0.9)
    mean = mean_success(outcomes(0.2, 0)[None], object_counts(scenes()["object_ids"]))
    assert row_of("random", table)[2] == f"{mean.low:.3f} to {mean.high:.3f}"


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
