"""`grasp-eval` from the command line: files, skipping, tables, exit status and one line for each mistake."""

import csv
import json
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest

from graspq.common.checksums import read_checked_json, write_checked_json
from graspq.common.files import sha256_of
from graspq.evaluate.films import read_films
from graspq.evaluate.recipe_digest import recipe_digest
from graspq.evaluate.records import Evaluation
from graspq.evaluate.results_table import outcomes_of, read_results
from graspq.evaluate.statistics import wilson_interval
from graspq.objects.object_set import ObjectSet
from graspq.sim.task import TASKS
from graspq.train.search_settings import CemSettings

SMALL = ("--episodes", "2", "--workers", "0")


@pytest.fixture(scope="module")
def workplace(run_folder: Path, dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """A run and the random policy, evaluated together by one command."""
    from graspq.evaluate.cli import evaluate
    from graspq.evaluate.settings import EvalSettings

    out = tmp_path_factory.mktemp("scores")
    settings = EvalSettings(runs=(str(run_folder),), policy=("random",), episodes=2, workers=0, films=2, out=out)
    return SimpleNamespace(out=out, settings=settings, status=evaluate(settings))


def files_of(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): sha256_of(path) for path in sorted(folder.rglob("*")) if path.is_file()}


def test_an_evaluation_holds_what_the_design_promises(
    workplace: SimpleNamespace, run_folder: Path, dataset: Path
) -> None:
    assert workplace.status == 0
    evaluation = Evaluation.load(workplace.out / "mc-regular-validation-seed0-2")
    summary, rows = evaluation.summary, evaluation.rows()
    assert [row.episode for row in rows] == [0, 1]
    assert (summary["task"], summary["split"], summary["episodes"], summary["seed"]) == ("regular", "validation", 2, 0)
    assert summary["successes"] == sum(row.success for row in rows)
    assert summary["success_rate"] == summary["successes"] / 2
    assert tuple(summary["ci95"]) == pytest.approx(wilson_interval(summary["successes"], 2))
    assert (summary["algo"], summary["checkpoint_step"], summary["run"]) == ("mc", 4, run_folder.as_posix())
    assert summary["object_set"]["sha256"] == sha256_of(dataset / "objects" / "object_set.json")
    assert summary["cem"] == {
        "iterations": 3, "samples": 64, "elites": 10, "answer": "mean", "views": 6, "synthetic_step": "scale",
    }  # fmt: skip
    assert summary["command"].startswith("grasp-eval ") and "--episodes 2" in summary["command"]
    assert summary["versions"]["pybullet"]
    assert {film.row.episode for film in read_films(evaluation)} <= {0, 1}


def test_the_test_split_is_told_from_the_one_to_choose_on(
    objects_folder: Path, command: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ("--policy", "random", "--objects", objects_folder, "--plan")
    assert command("grasp-eval", *words).lines == []
    (line,) = command("grasp-eval", *words, "--split", "test").lines
    assert line.startswith("--split test: for the one score of a recipe that is frozen") and "validation" in line


def test_several_jobs_give_one_table_in_two_formats(workplace: SimpleNamespace) -> None:
    rows = [json.loads(line) for line in (workplace.out / "results.jsonl").read_text().splitlines()]
    assert [(row["label"], row["status"]) for row in rows] == [("mc", "finished"), ("random", "finished")]
    with (workplace.out / "results.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [row["label"] for row in table] == ["mc", "random"]
    assert [float(row["success_rate"]) for row in table] == [row["success_rate"] for row in rows]
    assert rows[0]["object_set_sha256"] == rows[1]["object_set_sha256"]


def test_a_row_names_data_recipe_and_code_and_holds_every_outcome(workplace: SimpleNamespace, run_folder: Path) -> None:
    run, random = read_results(workplace.out / "results.jsonl")
    config = read_checked_json(run_folder / "config.json", "run", "")
    assert run["data_sha256"] == config["dataset"]["manifest_sha256"]
    assert (run["trained_by"], run["training_seed"]) == (config["code_revision"], 0)
    assert run["recipe_sha256"] == recipe_digest(config, CemSettings())
    assert run["scored_by"] == random["scored_by"] != ""
    assert "pybullet" in run["simulator"]
    for row in (run, random):
        episodes = Evaluation.load(Path(row["folder"])).rows()
        assert outcomes_of(row).tolist() == [one.success for one in episodes]
    assert [random[name] for name in ("data_sha256", "recipe_sha256", "trained_by", "training_seed")] == [None] * 4


def test_the_digest_of_a_recipe_follows_what_decides_what_is_learned_and_nothing_else(run_folder: Path) -> None:
    config = read_checked_json(run_folder / "config.json", "run", "")
    digest = recipe_digest(config, CemSettings())

    def changed(**settings: object) -> str:
        return recipe_digest({**config, "settings": {**config["settings"], **settings}}, CemSettings())

    for name, value in {"seed": 5, "out": "elsewhere", "shards": ["moved"], "threads": 7, "device": "cuda"}.items():
        assert changed(**{name: value}) == digest, name
    own = {**config["settings"]["own"], "discount": 0.123}
    others = {changed(learning_rate=0.5), changed(steps=7), changed(own=own), changed(validation_fraction=0.5)}
    others |= {
        recipe_digest(config, CemSettings(samples=32)),
        recipe_digest({**config, "online": {"a": 1}}, CemSettings()),
    }
    assert len(others | {digest}) == 7


def test_runs_of_several_training_seeds_are_summed_up_in_one_line(
    run_folder: Path, command: Any, tmp_path: Path
) -> None:
    for seed in (0, 1):
        shutil.copytree(run_folder, tmp_path / f"mc-seed{seed}")
        config = read_checked_json(run_folder / "config.json", "run", "")
        config["settings"]["seed"] = seed
        write_checked_json(tmp_path / f"mc-seed{seed}" / "config.json", config)
    done = command("grasp-eval", f"{tmp_path}/mc-seed*", *SMALL, "--films", "0", "--out", tmp_path / "scores")
    assert done.code == 0, done.err
    summed_up = r"^mc  regular validation  2 training seeds  [\d.]+ %  95 %: [\d.]+ to [\d.]+$"
    assert re.search(summed_up, done.out, re.MULTILINE)


def test_policies_of_one_seed_meet_the_same_scenes(workplace: SimpleNamespace) -> None:
    ours, theirs = (
        Evaluation.load(workplace.out / f"{name}-regular-validation-seed0-2").rows() for name in ("mc", "random")
    )
    assert [row.object_ids for row in ours] == [row.object_ids for row in theirs]


def test_policies_without_a_run_meet_the_scenes_of_the_run_beside_them(
    workplace: SimpleNamespace, run_folder: Path, tmp_path: Path
) -> None:
    from graspq.evaluate.job_units import make_plan
    from graspq.evaluate.jobs import jobs_from_settings

    other = tmp_path / "run"
    shutil.copytree(run_folder, other)
    config = read_checked_json(other / "config.json", "run", "")
    config["dataset"]["task"]["finger_force"] = 17.0
    write_checked_json(other / "config.json", config)
    run, random, oracle = make_plan(
        jobs_from_settings(replace(workplace.settings, runs=(str(other),), policy=("random", "oracle"))),
        workplace.settings,
    )
    assert run.prepared is not None and random.prepared is not None and oracle.prepared is not None
    assert run.prepared.task.settings.finger_force == 17.0
    assert run.prepared.task == random.prepared.task == oracle.prepared.task
    assert random.status == "to do"


def test_policies_without_a_run_are_given_the_task_that_the_runs_beside_them_have_in_common(
    workplace: SimpleNamespace, run_folder: Path, targeted_objects: ObjectSet, tmp_path: Path
) -> None:
    from graspq.evaluate.job_units import make_plan
    from graspq.evaluate.jobs import jobs_from_settings

    targeted = tmp_path / "targeted"
    shutil.copytree(run_folder, targeted)
    config = read_checked_json(targeted / "config.json", "run", "")
    config["dataset"]["task"] = TASKS["targeted"].settings.to_json()
    write_checked_json(targeted / "config.json", config)

    def tasks(*runs: Path, objects: Path | None = None) -> list[str]:
        settings = replace(workplace.settings, runs=tuple(map(str, runs)), policy=("oracle",), objects=objects)
        entries = make_plan(jobs_from_settings(settings), settings)
        return [
            entry.prepared.task.settings.name if entry.prepared is not None else str(entry.error) for entry in entries
        ]

    assert tasks(targeted, objects=targeted_objects.folder) == ["targeted", "targeted"]
    assert tasks(run_folder) == ["regular", "regular"]


def test_jobs_of_one_plan_that_differ_in_the_search_alone_have_folders_of_their_own(
    workplace: SimpleNamespace, run_folder: Path, tmp_path: Path
) -> None:
    from graspq.evaluate.job_units import make_plan
    from graspq.evaluate.jobs import jobs_from_settings

    settings = replace(workplace.settings, policy=(), out=tmp_path / "scores")
    (job,) = jobs_from_settings(settings)
    other = replace(job, cem=replace(job.cem, samples=32))
    plan = make_plan([job, other, job], settings)
    names = [planned.name for planned in plan]
    assert len(set(names)) == 2 and names[0] == names[2]
    assert [planned.done() for planned in plan] == [False] * 3


def test_finished_jobs_are_not_run_again_and_nothing_changes(
    workplace: SimpleNamespace, run_folder: Path, command: Any
) -> None:
    before = files_of(workplace.out)
    times = {path: path.stat().st_mtime_ns for path in workplace.out.rglob("eval.json")}
    done = command("grasp-eval", run_folder, "--policy", "random", *SMALL, "--films", "2", "--out", workplace.out)
    assert done.code == 0 and done.out.count("finished") == 2
    assert files_of(workplace.out) == before
    assert times == {path: path.stat().st_mtime_ns for path in workplace.out.rglob("eval.json")}


def test_another_job_never_overwrites_an_evaluation_and_a_damaged_one_is_to_do(
    workplace: SimpleNamespace, run_folder: Path, command: Any, tmp_path: Path
) -> None:
    out = tmp_path / "scores"
    shutil.copytree(workplace.out, out)
    plan = ("grasp-eval", run_folder, *SMALL, "--out", out, "--plan")
    assert "finished" in command(*plan).out
    other = command(*plan, "--checkpoint", "2")
    assert other.code == 0 and "to do" in other.out
    assert files_of(out) == files_of(workplace.out)
    with (out / "mc-regular-validation-seed0-2" / "episodes.jsonl").open("a") as file:
        file.write("{}\n")
    assert "to do" in command(*plan).out


def test_a_failed_job_leaves_the_others_alone_and_shows_in_the_exit_status(
    workplace: SimpleNamespace, run_folder: Path, command: Any, tmp_path: Path
) -> None:
    out = tmp_path / "scores"
    shutil.copytree(workplace.out, out)
    jobs = tmp_path / "jobs.toml"
    runs = json.dumps([str(tmp_path / "absent"), str(run_folder)])
    table = f'[[jobs]]\nruns = {runs}\npolicies = ["random"]\n'
    jobs.write_text("episodes = 2\n" + table)
    done = command("grasp-eval", "--jobs", jobs, "--out", out)
    assert done.code == 1
    assert "cannot run" in done.out and "absent" in done.err
    rows = [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]
    assert [(row["label"], row["status"]) for row in rows] == [
        ("absent", "failed"),
        ("mc", "finished"),
        ("random", "finished"),
    ]
    assert "no training run" in rows[0]["error"]


def test_a_users_policy_is_scored_and_filmed_by_the_same_command(
    objects_folder: Path, command: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = ("class Down:", "    def act(self, observation, rng):", "        return [0, 0, -1, 0]", "make = Down")
    (tmp_path / "straight_down.py").write_text("\n".join(source) + "\n")
    monkeypatch.chdir(tmp_path)
    done = command(
        "grasp-eval", "--policy", "straight_down:make", "--objects", objects_folder, "--split", "train",
        "--episodes", "1", "--workers", "1",
        "--video", "down.gif", "--video-size", "64", "--video-episodes", "1",
    )  # fmt: skip
    assert done.code == 0, done.err
    (row,) = Evaluation.load(Path("runs/baselines/straight_down.make-regular-train-seed0-1")).rows()
    assert (row.steps, row.ended_by) == (4, "height")
    assert all(name.startswith("train_") for name in row.object_ids)
    frames = np.stack([frame[..., :3] for frame in imageio.mimread(tmp_path / "down.gif")])
    assert len(frames) > 20 and frames.shape[1:] == (64, 64, 3)
    assert np.abs(frames[0].astype(int) - frames[len(frames) // 2]).max() > 60
    assert f"({int(row.success)} of 1 grasps" in done.out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "nothing to evaluate"),
        (("absent",), "absent/config.json: no training run"),
        (("--policy", "greedy"), "'greedy' is unknown"),
        (("--policy", "random", "--task", "stacking"), "unknown task 'stacking'; choose from regular, targeted"),
        (("--policy", "random", "--episodes", "0"), "expected a whole number of at least 1"),
        (("--policy", "random", "--episodes", "-3"), "expected a whole number of at least 1"),
        (("--policy", "random", "--episodes", "many"), "expected a whole number of at least 1"),
        (("--policy", "random", "--seed", "-1"), "expected a number of at least 0"),
        (("--policy", "random", "--objects", "absent"), "absent/object_set.json: no object set"),
        (("--policy", "random", "--objects", "OBJECTS", "--split", "test-clutter"), "split 'test-clutter'"),
        (("--policy", "random", "--objects", "OBJECTS", "--task", "targeted"), "'target'"),
        (("RUN", "--checkpoint", "3"), "no checkpoint of step 3"),
        (("RUN", "--task", "targeted", "--objects", "OBJECTS"), "'target'"),
        (("RUN/checkpoints/step-00000004",), "a checkpoint, expected its run"),
        (("RUN", "--cem-elites", "65"), "expected at most as many as samples (64), got 65"),
        (("RUN", "--objects", "OBJECTS", "--episodes", "1", "--out", "FILE"), "cannot write the evaluation here"),
        (("RUN", "--video", "film.avi"), "should end in .mp4 or .gif"),
        (("RUN", "--policy", "random", "--video", "film.gif"), "one job makes one video"),
        (("--policy", "no_such_module:make", "--objects", "OBJECTS"), "No module named 'no_such_module'"),
    ],
)
def test_a_mistake_is_one_line_and_status_two(
    arguments: tuple[str, ...],
    said: str,
    run_folder: Path,
    objects_folder: Path,
    command: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    places = {"RUN": str(run_folder), "OBJECTS": str(objects_folder), "FILE": "file/out"}
    words = [next((w.replace(k, v) for k, v in places.items() if w.startswith(k)), w) for w in arguments]
    done = command("grasp-eval", *words)
    assert done.code == 2, done
    assert len(done.lines) == 1 and said in done.lines[0], done.err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_damaged_mesh_is_refused_before_anything_runs(objects_folder: Path, command: Any, tmp_path: Path) -> None:
    damaged = tmp_path / "objects"
    shutil.copytree(objects_folder, damaged)
    victim = next((damaged / "meshes").glob("test_*.obj"))
    victim.write_bytes(victim.read_bytes()[:-20])
    done = command("grasp-eval", "--policy", "random", "--objects", damaged, *SMALL, "--out", tmp_path / "out")
    assert done.code == 2 and len(done.lines) == 1 and victim.name in done.lines[0]
    assert not (tmp_path / "out").exists()


def test_another_object_set_than_the_runs_must_be_asked_for(
    run_folder: Path, command: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from graspq.objects.procedural import GENERATOR_VERSION, SEED, make_procedural

    monkeypatch.chdir(tmp_path)
    moved = tmp_path / "run"
    shutil.copytree(run_folder, moved)
    config = read_checked_json(moved / "config.json", "run", "")
    config["dataset"]["object_set"] = {"name": "procedural", "sha256": "0" * 64}
    write_checked_json(moved / "config.json", config)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    own = make_procedural(
        tmp_path / f"graspq/objects/regular-{GENERATOR_VERSION}", seed=SEED, train=5, test=5, validation=5
    )
    done = command("grasp-eval", moved, *SMALL, "--plan")
    assert done.code == 2 and "not the object set of the run's data" in done.lines[0]
    assert command("grasp-eval", moved, *SMALL, "--plan", "--objects", own.folder).code == 0


def test_objects_that_a_run_was_trained_on_are_not_tested_under_another_name(
    run_folder: Path, objects_folder: Path, command: Any, tmp_path: Path
) -> None:
    renamed = tmp_path / "renamed"
    shutil.copytree(objects_folder, renamed)
    text = (renamed / "object_set.json").read_text()
    swap = {"train": "validation", "validation": "train"}
    values = json.loads(text)
    for one in values["objects"]:
        one["split"] = swap.get(one["split"], one["split"])
    (renamed / "object_set.json").write_text(json.dumps(values))
    (renamed / "object_set.json.sha256").unlink()
    words = (run_folder, *SMALL, "--plan", "--objects", renamed)
    refused = command("grasp-eval", *words)
    assert refused.code == 2 and len(refused.lines) == 1
    assert "of its split validation is train_000 of" in refused.lines[0]
    assert command("grasp-eval", *words, "--split", "train").code == 0
    assert command("grasp-eval", *words, "--split", "test").code == 0


OWN_ROW = """
import dataclasses
from graspq.train.estimators import ESTIMATORS
row = dataclasses.replace(ESTIMATORS["ddpg"], summary="my own")
"""


def test_a_run_of_a_users_own_row_is_evaluated_where_its_module_lies_and_acts_by_its_actor(
    dataset: Path, command: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from graspq.train.loop import train
    from graspq.train.settings import complete

    (tmp_path / "own_rows_of_a_user.py").write_text(OWN_ROW)
    monkeypatch.chdir(tmp_path)
    settings = complete(
        {
            "algo": "own_rows_of_a_user:row",
            "shards": (str(dataset),),
            "out": tmp_path / "run",
            "steps": 1,
            "batch_size": 8,
            "validation_fraction": 0.0,
            "device": "cpu",
            "precision": "float32",
            "threads": 1,
        },
        "paper",
    )
    train(settings)
    done = command("grasp-eval", "run", *SMALL, "--out", "scores", "--films", "0")
    assert done.code == 0, done.err
    (row,) = [json.loads(line) for line in Path("scores/results.jsonl").read_text().splitlines()]
    assert (row["label"], row["policy"], row["algo"]) == ("run", "actor", "own_rows_of_a_user:row")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    monkeypatch.delitem(sys.modules, "own_rows_of_a_user")
    refused = command("grasp-eval", "../run", *SMALL, "--out", "scores")
    assert refused.code == 2
    assert "run it where own_rows_of_a_user is" in refused.lines[-1]
