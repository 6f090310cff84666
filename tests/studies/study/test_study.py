"""A real study from the command: killed, gone on with, done once; what has other settings is refused."""

import json
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from graspq.common.checksums import checked_lines
from graspq.common.files import sha256_of
from graspq.evaluate.results_table import outcomes_of
from graspq.studies.study.cli import main
from graspq.studies.study.scores import read_scores


def grasp_study(*words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(words, prog_name="grasp-study")
    return int(ended.value.code or 0)


@pytest.mark.slow
def test_a_study_that_is_killed_goes_on_where_it_was_and_is_done_once(
    plan: Callable[..., Any], data: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    plan(data=data)
    words = ["run", "tiny.toml", "--out", "study", "--device", "cpu"]
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", f"from graspq.studies.study.cli import main; main({words})"]
    )
    while not list(Path("study/runs").glob("*/config.json")):
        assert process.poll() is None
        time.sleep(0.02)
    process.kill()
    process.wait()
    time.sleep(5)  # its workers end by themselves, and hold the run until then

    assert grasp_study(*words, "--workers", "0") == 0
    table = [json.loads(line) for line in Path("study/study.jsonl").read_text().splitlines()]
    assert [row["kind"] for row in table] == ["scenes", "reference", *["run"] * 6]
    assert len(table[0]["object_ids"]) == 2 and table[1]["policy"] == "random"
    rows = table[2:]
    assert [(row["row"], row["seed"]) for row in rows[:3]] == [("mc", 0), ("dql-width4", 0), ("dql-width5", 0)]
    assert {(row["status"], row["steps"], row["split"], row["recipe_frozen"]) for row in rows} == {
        ("done", 3, "validation", False)
    }
    assert all(len(outcomes_of(row)) == 2 for row in rows)
    assert len({row["recipe_sha256"] for row in rows}) == 3 and len({row["data_sha256"] for row in rows}) == 1

    page = Path("RESULTS.md").read_text()
    assert "6 of 6 trainings" in page and all(f"| `{row['recipe_sha256'][:8]}` |" in page for row in rows)
    assert Path("results/study-tiny.jsonl").read_bytes() == Path("study/study.jsonl").read_bytes()

    before = {path: sha256_of(path) for path in Path("study").rglob("eval.json")}
    assert len(before) == 7  # six runs and the random policy
    (table_of_random,) = Path("study/references").rglob("results.csv")
    table_of_random.unlink()  # as where it was killed just before
    assert grasp_study(*words, "--workers", "0") == 0
    assert "6 of 6 trainings finished before" in capfd.readouterr().err
    assert table_of_random.is_file()
    Path("RESULTS.md").unlink()
    assert grasp_study("report", "tiny.toml", "--out", "elsewhere") == 0  # judged again without the runs
    assert Path("RESULTS.md").read_text() == page
    assert {path: sha256_of(path) for path in Path("study").rglob("eval.json")} == before
    capfd.readouterr()
    words_beside = ["report", "tiny.toml", "--out", "elsewhere", "--beside", "results/study-tiny.jsonl"]
    assert grasp_study(*words_beside) == 2  # the same runs again
    (line,) = capfd.readouterr().err.strip().splitlines()
    assert "seed 0 stands there twice" in line

    plan(("batch_size = 8", "batch_size = 4"), data=data)
    assert grasp_study(*words) == 2
    assert "batch_size = 4 now, 8 when it was trained" in capfd.readouterr().err


@pytest.mark.slow
def test_a_study_goes_on_in_another_clone_from_what_was_published(
    plan: Callable[..., Any], data: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    one = ('rows = ["mc", {algo = "dql", width = [4, 5]}]', 'rows = ["mc"]')
    words = ["run", "tiny.toml", "--device", "cpu", "--workers", "0", "--keep-published"]
    plan(one, ("seeds = 2", "seeds = 1"), data=data)
    assert grasp_study(*words, "--out", "first") == 0
    published = Path("results/study-tiny.jsonl")
    lines = read_scores([published])
    assert [line["kind"] for line in lines] == ["scenes", "reference", "run"]
    lines[0]["marked"] = lines[1]["marked"] = lines[2]["marked"] = 1
    published.write_text(checked_lines(lines))

    plan(one, data=data)
    capfd.readouterr()
    assert grasp_study(*words, "--out", "second", "--dry-run") == 0
    planned = capfd.readouterr().out
    assert re.findall(r"-seed(\d) +(published|to do)\n", planned) == [("0", "published"), ("1", "to do")]
    assert "The commands of mc-regular-12-seed1" in planned and "--seed 1" in planned
    assert "2 trainings, 1 done, 1 of them published" in planned and not Path("second").exists()
    Path("second").mkdir()
    assert grasp_study("report", "tiny.toml", "--keep-published", "--out", "second") == 0
    assert read_scores([published])[:3] == lines  # the objects of the scenes too, where no evaluation is here
    capfd.readouterr()
    assert grasp_study(*words, "--out", "second") == 0
    assert "1 of 2 trainings finished before, 1 of them published" in capfd.readouterr().err
    assert [path.name for path in Path("second/runs").iterdir()] == ["mc-regular-12-seed1"]
    assert not Path("second/references").exists()  # nor is what stands beside the runs scored again
    (scenes, reference, *rows) = read_scores([published])
    assert scenes["object_ids"] == lines[0]["object_ids"] and reference["marked"] == 1
    assert [(row["seed"], row["status"], "marked" in row) for row in rows] == [(0, "done", True), (1, "done", False)]
    assert "2 of 2 trainings" in Path("RESULTS.md").read_text()

    # Another recipe is not the published one; other data of the same name are refused before anything is done.
    plan(one, ("batch_size = 8", "batch_size = 4"), data=data)
    assert grasp_study(*words, "--out", "third") == 0
    assert "0 of 2 trainings finished before" in capfd.readouterr().err
    lines[2]["data_sha256"] = "0" * 64
    published.write_text(checked_lines(lines))
    plan(one, data=data)
    assert grasp_study(*words, "--out", "fourth") == 2
    assert "trained on other data" in capfd.readouterr().err and not Path("fourth").exists()


def test_a_mistake_is_one_line_before_anything_is_collected_or_trained(
    plan: Callable[..., Any], capfd: pytest.CaptureFixture[str]
) -> None:
    for replaced, said in (
        (("width = 4,", "width = 4, nu = 1,"), "no option nu"),
        (("steps = 3", "steps = 3\nsplit = 'test'"), "grasp-study freeze"),
    ):
        plan(replaced)
        assert grasp_study("run", "tiny.toml", "--out", "study") == 2
        assert said in capfd.readouterr().err.strip().splitlines()[-1]
        assert sorted(Path().iterdir()) == [Path("tiny.toml")]
