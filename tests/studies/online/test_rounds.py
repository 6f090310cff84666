"""Whole runs: killed at any moment and resumed, they end in the same dataset, weights and metrics."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from graspq.common.errors import UserError
from graspq.common.files import sha256_of
from graspq.datagen import collect
from graspq.datasets.dataset import open_shards
from graspq.datasets.manifest import Manifest
from graspq.datasets.verify import verify
from graspq.objects.object_set import ObjectSet
from graspq.policies.of_run import load
from graspq.studies.online import growth
from graspq.studies.online.resolve import Plan
from graspq.studies.online.rounds import run_online
from graspq.studies.study.scores import fresh_grasps
from graspq.train import loop, session
from graspq.train.estimators import ESTIMATORS
from graspq.train.run import Run
from graspq.train.search_settings import CemSettings

Make = Callable[..., Plan]


class KilledError(BaseException):
    """Ends a run where it stands."""


def digests(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): sha256_of(path) for path in sorted(folder.rglob("*")) if path.is_file()}


def outcome(run: Run) -> dict[str, Any]:
    """Return all that a run leaves but its figures of speed."""
    rows = [{name: value for name, value in row.items() if name != "samples_per_second"} for row in run.metrics()]
    return {
        "dataset": digests(run.folder / "dataset"),
        "checkpoints": digests(run.checkpoints_folder),
        "metrics": rows,
    }


@pytest.fixture(scope="module")
def unbroken(make_plan: Make, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return run_online(make_plan(tmp_path_factory.mktemp("online") / "unbroken"))


def test_rounds_collect_first_and_train_then_on_all_so_far(unbroken: Run) -> None:
    rows = [row for row in unbroken.metrics() if "online" in row]
    assert [row["step"] for row in rows] == [6, 12, 18]
    assert [row["online"]["round"] for row in rows] == [1, 2, 3]
    assert [row["online"]["grasps_so_far"] for row in rows] == [2, 4, 6]
    assert fresh_grasps(unbroken.metrics()) == 6
    assert [row["online"]["exploration"] for row in rows] == pytest.approx([0.715, 0.43, 0.145], abs=1e-9)
    assert unbroken.checkpoint().name == "step-00000024"
    losses = [row["step"] for row in unbroken.metrics() if "loss" in row]
    assert losses[0] > 6 and losses[-1] == 24


def test_the_grasps_are_a_dataset_that_says_how_it_was_made(unbroken: Run) -> None:
    folder = unbroken.folder / "dataset"
    report = verify(folder)
    assert report.faults == () and report.notes[1:] == ()
    grasps = list(open_shards([folder]))
    assert [episode.episode_id for episode in grasps] == list(range(6))
    assert [episode.policy for episode in grasps[::2]] == ["dql@6", "dql@12", "dql@18"]
    assert [episode.exploration for episode in grasps[::2]] == pytest.approx([0.715, 0.43, 0.145], abs=1e-9)
    assert Manifest.load(folder).settings["online"]["start"]["step"] == 6
    train_objects = ObjectSet.load(folder / "objects").ids("train")
    assert {name for episode in grasps for name in episode.object_ids} <= set(train_objects)


def test_grasp_train_could_read_base_and_new_grasps_as_one_pool(unbroken: Run, base: Path) -> None:
    assert open_shards([base, unbroken.folder / "dataset"]).episodes == 46


def test_the_run_folder_is_one_for_evaluation(unbroken: Run) -> None:
    policy = load(unbroken.folder, device="cpu")
    assert (policy.name, policy.origin.task["name"]) == ("dql@24", "regular")
    assert policy.identity()["cem"] == CemSettings().to_json()


def test_the_start_runs_weights_and_moments_are_taken_over_and_it_is_left_alone(
    make_plan: Make, start: Path, tmp_path: Path
) -> None:
    before = digests(start)
    run = run_online(make_plan(tmp_path / "run", rounds=1, steps_per_round=1))
    theirs, ours = digests(start / "checkpoints/step-00000006"), digests(run.checkpoint(6))
    assert ours == theirs
    assert digests(run.checkpoint(7)) != theirs
    assert digests(start) == before


def killed_at(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, call: int) -> None:
    """Let the given call of a function end the run before it does anything."""
    original, calls = getattr(owner, name), []

    def deadly(*arguments: Any, **named: Any) -> Any:
        calls.append(name)
        if len(calls) == call:
            raise KilledError
        return original(*arguments, **named)

    monkeypatch.setattr(owner, name, deadly)


COLLECTING = [
    (collect, "collect_block", 1),  # before the first grasp
    (growth, "write_shard", 1),  # a round is collected but not written
    (growth, "commit_shard", 1),  # written, but not in the manifest
    (growth, "commit_shard", 2),  # the same in the next round
    (growth, "write_card", 2),  # in the manifest, the card is that of the round before
]
TRAINING = [
    (session, "save_checkpoint", 1),  # before the first
    (Run, "append_metrics", 1),  # grasps are committed, their row is missing
    (loop, "update", 9),  # between two checkpoints
    (session, "save_checkpoint", 2),  # at one
    (Run, "append_metrics", 4),
    (loop, "update", 2),
]


@pytest.mark.parametrize("moments", [COLLECTING, TRAINING], ids=["collecting", "training"])
def test_killed_again_and_again_and_resumed_it_ends_as_an_unbroken_run(
    monkeypatch: pytest.MonkeyPatch,
    make_plan: Make,
    unbroken: Run,
    tmp_path: Path,
    moments: list[tuple[Any, str, int]],
) -> None:
    plan = make_plan(tmp_path / "run")
    for owner, name, call in moments:
        with monkeypatch.context() as patch, pytest.raises(KilledError):
            killed_at(patch, owner, name, call)
            run_online(plan)
    assert outcome(run_online(plan)) == outcome(unbroken)


COMMAND = "from graspq.studies.online.cli import main; main()"


def command(start: Path, out: Path) -> list[str]:
    options = ["--start", start, "--out", out, "--rounds", 3, "--grasps", 2, "--steps-per-round", 6, "--workers", 1]
    return [sys.executable, "-P", "-c", COMMAND, *map(str, options), "--exploration-steps", "20"]


def test_the_command_killed_with_sigkill_and_resumed_ends_as_an_unbroken_run(
    make_plan: Make, unbroken: Run, start: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    process = subprocess.Popen(command(start, out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 300
        while len(list((out / "dataset/shards").glob("blocks-*"))) < 2:
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.02)
        os.kill(process.pid, signal.SIGKILL)
    finally:
        process.kill()
        process.wait()
    assert len(Manifest.load(out / "dataset").shards) < 3
    assert outcome(run_online(make_plan(out))) == outcome(unbroken)


def test_a_finished_run_is_left_as_it_is(make_plan: Make, unbroken: Run) -> None:
    before = outcome(unbroken)
    run_online(make_plan(unbroken.folder))
    assert outcome(unbroken) == before


def test_a_run_of_other_rounds_or_another_start_is_not_touched(make_plan: Make, unbroken: Run) -> None:
    before = outcome(unbroken)
    for other in ({"grasps": 5}, {"exploration_end": 0.5}, {"checkpoint": 3, "rounds": 3}, {"seed": 1}):
        with pytest.raises(UserError, match="choose another folder with --out"):
            run_online(make_plan(unbroken.folder, **other))
    assert outcome(unbroken) == before


def test_a_run_of_rounds_is_no_start_of_another(make_plan: Make, unbroken: Run, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is a run of grasp-online; name one of grasp-train"):
        make_plan(tmp_path / "run", start=unbroken.folder)


@pytest.mark.parametrize("algo", ESTIMATORS)
def test_from_scratch_every_estimator_needs_the_pool_alone_and_collects_by_its_latest_weights(
    base: Path, make_plan: Make, tmp_path: Path, algo: str
) -> None:
    plan = make_plan(
        tmp_path / "run", start=None, algo=algo, shards=(str(base),), preset="paper", width=4, batch_size=8,
        rounds=2, grasps=1, steps_per_round=1, exploration_end=0.0, exploration_steps=1, threads=1, device="cpu",
        validation_fraction=0.2, cem_samples=8, cem_elites=2,
    )  # fmt: skip
    run = run_online(plan)
    grasps = list(open_shards([run.folder / "dataset"]))
    assert [(episode.policy, episode.exploration) for episode in grasps] == [(f"{algo}@0", 1.0), (f"{algo}@1", 0.0)]
    assert run.config["online"]["start"] is None and run.checkpoint().name == "step-00000002"
