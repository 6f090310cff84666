"""A run is taken again from its configuration, and gives the metrics that it recorded."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from graspq.common.checksums import read_checked_json, write_checked_json
from graspq.train.cli import main
from graspq.train.loop import train
from graspq.train.replay import compared
from graspq.train.run import Run
from graspq.train.settings import TrainSettings

Make = Callable[..., TrainSettings]


@pytest.fixture
def run(settings: Make) -> Run:
    """A run of 120 steps that was stopped at step 30 and resumed."""
    asked = settings("dql", steps=120, save_every=40)
    train(asked, stop_at=30)
    return train(asked)


def verified(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    with pytest.raises(SystemExit) as ended:
        main(["--verify-replay", *words], prog_name="grasp-train")
    output = capsys.readouterr()
    return int(str(ended.value.code)), output.out or output.err


def test_a_run_is_taken_again_bit_for_bit_from_its_configuration_alone(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    moved = tmp_path / "moved"
    moved.mkdir()
    for name in ("config.json", "metrics.jsonl"):
        shutil.copy(run.folder / name, moved)
    status, said = verified(capsys, str(moved))
    # The row of step 40 is of steps 31 to 40, as the run was stopped before.
    assert status == 0 and re.fullmatch(
        r".*: \d+ recorded values of steps 50, 80, 100 are the same bit for bit\n", said
    )
    config = read_checked_json(moved / "config.json", "run", "")
    config["settings"]["learning_rate"] *= 1.01
    write_checked_json(moved / "config.json", config)
    status, said = verified(capsys, str(moved))
    assert status == 1 and "do not fit within 0.001" in said


def test_what_cannot_be_taken_again_is_one_line(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = str(run.folder)
    assert verified(capsys, folder, "--seed", "3") == (
        2,
        f"error: --verify-replay: takes the settings of {folder} alone; leave out --seed\n",
    )
    assert "no training run" in verified(capsys, str(tmp_path / "nowhere"))[1]
    run.metrics_file.unlink()
    assert "has no metrics of its first 100 steps" in verified(capsys, folder)[1]


def test_values_that_one_side_lacks_do_not_fit() -> None:
    rows = {(0, 50): {"loss": 1.0, "q": 0.5}}
    assert compared(rows, rows).largest == 0.0
    assert compared(rows, {(0, 50): {"loss": 1.0005, "q": 0.5}}).holds
    assert not compared(rows, {(0, 50): {"loss": 1.002, "q": 0.5}}).holds
    assert not compared(rows, {(0, 50): {"loss": 1.0}}).holds
    assert not compared(rows, {(10, 50): {"loss": 1.0, "q": 0.5}}).holds
