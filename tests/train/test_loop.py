"""Runs: exact resumption after any stop, refusal of what does not fit, and a halt on numbers that are not finite."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from graspq.common.action_space import ActionSpace
from graspq.common.checksums import with_checksum
from graspq.common.errors import UserError
from graspq.train import loop
from graspq.train.acting import Acting, ObservedState
from graspq.train.batch import Batch
from graspq.train.checkpoint import load_acting
from graspq.train.estimator import Metrics
from graspq.train.estimators import ESTIMATORS
from graspq.train.loop import train
from graspq.train.run import Run
from graspq.train.search_settings import CemSettings
from graspq.train.session import DivergedError, Session
from graspq.train.settings import TrainSettings

Make = Callable[..., TrainSettings]


def same_checkpoints(first: Path, second: Path) -> bool:
    names = sorted(path.name for path in first.iterdir())
    assert names == sorted(path.name for path in second.iterdir())
    return all((first / name).read_bytes() == (second / name).read_bytes() for name in names)


@pytest.mark.parametrize("algo", ESTIMATORS)
def test_twenty_steps_equal_ten_steps_a_checkpoint_and_ten_steps_bit_by_bit(
    settings: Make, tmp_path: Path, algo: str
) -> None:
    own = {"lag_steps": 7} if hasattr(ESTIMATORS[algo].settings(), "lag_steps") else {}
    unbroken = train(settings(algo, out=tmp_path / "unbroken", **own))
    train(settings(algo, out=tmp_path / "broken", **own), stop_at=10)
    torch.manual_seed(99)
    resumed = train(settings(algo, out=tmp_path / "broken", **own))
    assert [row["step"] for row in resumed.metrics()] == [row["step"] for row in unbroken.metrics()]
    assert same_checkpoints(unbroken.checkpoint(), resumed.checkpoint())


def test_a_run_without_steps_takes_those_of_its_data_and_goes_on_when_asked_again(settings: Make) -> None:
    asked = settings("mc", steps=None, batch_size=256)
    run = train(asked)
    steps = asked.for_grasps(run.config["dataset"]["episodes"]).last_step
    assert run.config["settings"]["steps"] == run.metrics()[-1]["step"] == steps
    assert train(asked).metrics() == run.metrics()


def test_a_run_stopped_between_checkpoints_ends_in_the_same_weights(settings: Make, tmp_path: Path) -> None:
    unbroken = train(settings("dql", out=tmp_path / "unbroken"))
    train(settings("dql", out=tmp_path / "broken"), stop_at=3)
    resumed = train(settings("dql", out=tmp_path / "broken"))
    assert same_checkpoints(unbroken.checkpoint(20), resumed.checkpoint(20))


def test_another_seed_gives_other_weights(settings: Make, tmp_path: Path) -> None:
    first = train(settings(out=tmp_path / "first", steps=3))
    other = train(settings(out=tmp_path / "other", steps=3, seed=1))
    assert not same_checkpoints(first.checkpoint(), other.checkpoint())


def test_what_was_killed_is_taken_up_from_the_last_checkpoint_without_double_metrics(
    settings: Make, tmp_path: Path
) -> None:
    unbroken = train(settings(out=tmp_path / "unbroken"))
    run = train(settings(out=tmp_path / "broken"), stop_at=10)
    # What a kill leaves: metrics beyond the checkpoint, a row cut short, and a half-written checkpoint.
    with run.metrics_file.open("a") as file:
        file.write(with_checksum({"step": 15, "loss": 123.0}) + '{"step": 20, "lo')
    (run.checkpoints_folder / ".tmp-1-step-00000020").mkdir()
    resumed = train(settings(out=tmp_path / "broken"))
    assert [row.get("loss") for row in resumed.metrics()] == [row.get("loss") for row in unbroken.metrics()]
    assert [path.name for path in run.checkpoints_folder.iterdir() if path.name.startswith(".")] == []
    assert same_checkpoints(unbroken.checkpoint(), resumed.checkpoint())


def test_a_finished_run_is_left_as_it_is(settings: Make) -> None:
    run = train(settings(steps=4))
    before = {path: path.stat().st_mtime_ns for path in run.checkpoint().iterdir()}
    train(settings(steps=4))
    assert {path: path.stat().st_mtime_ns for path in run.checkpoint().iterdir()} == before


def test_metrics_have_losses_rates_and_validation(settings: Make) -> None:
    run = train(settings())
    rows = run.metrics()
    training = [row for row in rows if "loss" in row]
    assert [row["step"] for row in training] == [10, 20]
    assert set(training[0]) == {"step", "loss", "q", "target", "samples_per_second", "learning_rate"}
    validation = [row for row in rows if "validation" in row]
    assert [row["step"] for row in validation] == [10, 20]
    measures = validation[-1]["validation"]
    assert measures["last_steps"] < measures["transitions"] <= run.config["dataset"]["held_back"]["rows"]
    assert len(measures["calibration"]) == 10 and 0 <= measures["roc_auc_last_step"] <= 1
    assert list((run.folder / "tensorboard").glob("events.*"))


def test_the_configuration_names_settings_data_versions_and_precision(settings: Make) -> None:
    config = json.loads((train(settings(steps=2)).folder / "config.json").read_text())
    assert config["settings"]["algo"] == "mc" and config["dataset"]["discount"] == 1.0
    assert len(config["dataset"]["manifest_sha256"]) == 64 and config["dataset"]["task"]["name"] == "two-states"
    assert config["precision"] == "float32"
    assert "torch" in config["versions"] and config["code_revision"]
    assert config["network"]["name"] == "default"
    split = config["dataset"]["training"]["blocks"], config["dataset"]["held_back"]["blocks"]
    assert sum(split) == 60 and split[1] >= 1


def test_only_the_newest_checkpoints_are_kept(settings: Make) -> None:
    run = train(settings(steps=10, save_every=2))
    assert [path.name for path in run.checkpoints()] == ["step-00000006", "step-00000008", "step-00000010"]
    # A cut after the last checkpoint and before the removal of an older one.
    shutil.copytree(run.checkpoint(6), run.checkpoints_folder / "step-00000004")
    train(settings(steps=10, save_every=2))
    assert [path.name for path in run.checkpoints()] == ["step-00000006", "step-00000008", "step-00000010"]


def test_no_whole_checkpoint_is_removed_for_damaged_newer_ones(settings: Make) -> None:
    run = train(settings(steps=10, save_every=2))
    for path in run.checkpoints()[1:]:
        (path / "state.json").write_text("{")
    train(settings(steps=10, save_every=2), stop_at=7)
    names = [path.name for path in run.checkpoints()]
    assert names == ["step-00000006", "step-00000007", "step-00000008", "step-00000010"]


def test_a_run_of_another_configuration_is_not_touched(
    settings: Make, two_states: SimpleNamespace, tmp_path: Path
) -> None:
    train(settings(steps=4))
    with pytest.raises(UserError, match=r"holds a run with learning_rate = 0.002, not 0.1; choose another folder"):
        train(settings(steps=4, learning_rate=0.1))
    other = two_states.dataset(tmp_path / "other", 50)
    with pytest.raises(UserError, match="another dataset"):
        train(settings(steps=4, shards=(str(other),)))
    train(settings(steps=4, save_every=1, threads=None))


def test_data_that_has_moved_is_the_same_data(settings: Make, two_states: SimpleNamespace, tmp_path: Path) -> None:
    moved = two_states.dataset(tmp_path / "moved", 60)
    train(settings(steps=4), stop_at=2)
    assert train(settings(steps=4, shards=(str(moved),))).checkpoint().name == "step-00000004"


def test_a_folder_of_something_else_is_not_touched(settings: Make, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "thesis.tex").write_text("years of work")
    with pytest.raises(UserError, match="not empty and not a training run"):
        train(settings())


def test_two_trainings_do_not_share_a_folder(settings: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graspq.common.files.LOCK_SECONDS", 0.1)
    run = train(settings(steps=2))
    with Run.held(run.folder, run.config, frozenset()), pytest.raises(UserError, match="another training works here"):
        train(settings(steps=2))


def test_of_two_trainings_that_begin_in_one_folder_the_second_finds_the_settings_of_the_first(
    settings: Make, tmp_path: Path
) -> None:
    folder, first, second = tmp_path / "run", {"settings": {"seed": 0}}, {"settings": {"seed": 1}}
    with ThreadPoolExecutor(1) as executor:
        with Run.held(folder, first, frozenset()):
            late = executor.submit(lambda: Run.held(folder, second, frozenset()).__enter__())
            time.sleep(0.3)
        with pytest.raises(UserError, match="holds a run with seed = 0, not 1"):
            late.result()
    assert Run.open(folder).config == first


def test_another_discount_makes_the_returns_of_mc_anew_and_says_so(
    settings: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seen, said = [], []
    for discount in (None, 1.0, 0.5):
        run = train(settings("mc", discount=discount, steps=2, out=tmp_path / str(discount)))
        assert run.config["settings"]["own"]["discount"] == discount and run.config["dataset"]["discount"] == 1.0
        seen.append(next(row["target"] for row in run.metrics() if "target" in row))
        said.append((run.config["discount"], run.config["mc_return"]))
    assert seen[0] == seen[1] > seen[2]
    assert said == [(1.0, "as stored")] * 2 + [(0.5, "made from the rewards with discount 0.5")]
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "mc: returns are made from the rewards with discount 0.5; the data's are of discount 1"


def test_divergence_stops_with_estimator_step_quantity_and_the_last_good_checkpoint(settings: Make) -> None:
    with pytest.raises(DivergedError) as error:
        train(settings("mc", preset="paper", network="default", steps=40, learning_rate=1e30, save_every=1))
    message = str(error.value)
    assert message.startswith("mc diverged at step ") and "is not finite" in message and "\n" not in message


def test_the_step_of_a_loss_that_is_not_finite_is_named_and_the_checkpoint_before_it_kept(
    settings: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = settings(steps=30, save_every=3)
    run = train(chosen, stop_at=3)

    def poisoned(current: Session, batch: Batch) -> Metrics:
        metrics = original(current, batch)
        return metrics | {"loss": metrics["loss"] * torch.nan} if current.state.step == 5 else metrics

    original = loop.update
    monkeypatch.setattr(loop, "update", poisoned)
    with pytest.raises(DivergedError, match=r"mc diverged at step 5: the loss is not finite; .*step-00000003 is"):
        train(chosen)
    assert run.latest_checkpoint() == run.folder / "checkpoints/step-00000003"


COMMAND = "from graspq.train.cli import main; main()"


def command(settings: TrainSettings, *more: str) -> list[str]:
    assert settings.out is not None
    options = ["--algo", settings.algo, "--shards", *settings.shards, "--out", str(settings.out), "--steps", "5000"]
    options += ["--batch-size", "8", "--precision", "float32", "--threads", "1", "--save-every", "10"]
    return [sys.executable, "-c", COMMAND, *options, *more]


def wait_for_checkpoint(folder: Path, process: "subprocess.Popen[str]") -> None:
    for _ in range(600):
        if (folder / "checkpoints").is_dir() and list((folder / "checkpoints").glob("step-*")):
            return
        assert process.poll() is None, process.communicate()
        time.sleep(0.1)
    raise AssertionError("no checkpoint within a minute")


def started(settings: TrainSettings) -> "subprocess.Popen[str]":
    assert settings.out is not None
    process = subprocess.Popen(
        command(settings),
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    return process


def test_a_run_that_is_killed_or_interrupted_keeps_a_checkpoint_that_loads(settings: Make, tmp_path: Path) -> None:
    killed, interrupted = settings(out=tmp_path / "killed"), settings(out=tmp_path / "interrupted")
    processes = [started(killed), started(interrupted)]
    try:
        for process, chosen, number in zip(
            processes, (killed, interrupted), (signal.SIGKILL, signal.SIGINT), strict=True
        ):
            wait_for_checkpoint(chosen.run_folder, process)
            process.send_signal(number)
        errors = [process.communicate(timeout=60)[1] for process in processes]
    finally:
        for process in processes:
            process.kill()
    for chosen in (killed, interrupted):
        assert load_acting(chosen.run_folder).step >= 10
    assert processes[1].returncode == 130
    assert errors[1].strip().splitlines()[-1] == "interrupted" and "Traceback" not in errors[1]
    run = Run.open(interrupted.run_folder)
    assert run.checkpoints()[-1].name == f"step-{max(row['step'] for row in run.metrics()):08d}"


def test_training_works_outside_the_main_thread(settings: Make) -> None:
    done: list[Run] = []
    thread = threading.Thread(target=lambda: done.append(train(settings(steps=2))))
    thread.start()
    thread.join(60)
    assert done and done[0].checkpoint().name == "step-00000002"


FIVE_PARTS = ActionSpace(
    names=("dx", "dy", "dz", "dphi", "dtheta"),
    pose=("x", "y", "z", "phi", "theta"),
    units=("m", "m", "m", "rad", "rad"),
    limits=(0.05, 0.05, 0.05, 0.3, 0.2),
    mirror=None,
    start=(0.0, 0.0, 0.0, 0.0, 0.5),
)


@pytest.fixture(scope="module")
def five_parts(two_states: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = two_states.dataset(tmp_path_factory.mktemp("five") / "parts", 20, action=FIVE_PARTS)
    return folder


@pytest.mark.parametrize("network", ["default", "paper"])
@pytest.mark.parametrize("algo", ESTIMATORS)
def test_actions_of_five_parts_without_a_mirror_plane_train_every_row_and_act(
    settings: Make, five_parts: Path, algo: str, network: str
) -> None:
    run = train(settings(algo, shards=(str(five_parts),), network=network, steps=3, batch_size=16))
    loaded = load_acting(run.folder)
    assert loaded.specification.action == FIVE_PARTS
    bounds = torch.full((5,), -1.0), torch.full((5,), 1.0)
    acting = Acting(loaded.networks, loaded.kept, loaded.specification.action, bounds)
    image, step = torch.zeros(1, 16, 16, 3, dtype=torch.uint8), torch.zeros(1, dtype=torch.int64)
    state, random = ObservedState(image, step, pose=torch.zeros(1, 5)), np.random.default_rng(0)
    action, _ = ESTIMATORS[algo].action_selection.act(acting, state, random, CemSettings())
    assert action.shape == (1, 5) and float(action.abs().max()) <= 1
