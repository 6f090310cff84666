"""The command: one line for what went well, and one line for every mistake."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from graspq.train.cli import main
from graspq.train.run import Run

SHORT = ["--steps", "3", "--batch-size", "16", "--network", "default", "--precision", "float32", "--threads", "1"]


class Command:
    """Runs `grasp-train` in this process, in an empty folder."""

    def __init__(self, folder: Path, capture: pytest.CaptureFixture[str]) -> None:
        self.folder, self._capture = folder, capture

    def __call__(self, *options: str) -> SimpleNamespace:
        with pytest.raises(SystemExit) as ended:
            main(options, prog_name="grasp-train")
        output = self._capture.readouterr()
        return SimpleNamespace(returncode=ended.value.code, stdout=output.out, stderr=output.err)


@pytest.fixture
def grasp_train(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    monkeypatch.chdir(tmp_path)
    return Command(tmp_path, capsys)


def test_a_run_goes_to_its_default_folder_and_ends_with_one_line(dataset: Path, grasp_train: Command) -> None:
    done = grasp_train("--algo", "mc", "--shards", str(dataset), *SHORT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("runs/mc-two-states-seed0; step 3, loss 0.")
    assert done.stdout.count("\n") == 1 and "held-back loss" in done.stdout and "ROC AUC" in done.stdout
    assert (grasp_train.folder / "runs/mc-two-states-seed0/config.json").is_file()


@pytest.mark.parametrize(
    ("options", "mirror", "batch_size"),
    [
        ([], True, 256),
        (["--no-mirror"], False, 256),
        (["--preset", "paper"], False, 32),
        (["--preset", "paper", "--mirror", "--batch-size", "64"], True, 64),
    ],
)
def test_the_preset_decides_what_the_command_line_leaves_out(
    dataset: Path, grasp_train: Command, options: list[str], mirror: bool, batch_size: int
) -> None:
    common = ["--network", "default", "--steps", "1", "--precision", "float32", "--threads", "1", "--out", "run"]
    done = grasp_train("--algo", "mc", "--shards", str(dataset), *common, *options)
    assert done.returncode == 0, done.stderr
    settings = Run.open(grasp_train.folder / "run").config["settings"]
    assert (settings["mirror"], settings["batch_size"]) == (mirror, batch_size)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--algo", "sarsa", "--shards", "x"], "--algo: 'sarsa' is unknown; choose from supervised, dql, mc, corr-mc"),
        (["--algo", "mc"], "Missing option '--shards'"),
        (["--algo", "mc", "--shards", "nowhere"], "nowhere"),
        (["--algo", "mc", "--shards", "."], "."),
        (["--algo", "mc", "--shards", "x", "--steps", "0"], "--steps"),
        (["--algo", "mc", "--shards", "x", "--learning-rate", "fast"], "--learning-rate"),
    ],
)
def test_a_mistake_gives_one_line_and_status_2(grasp_train: Command, options: list[str], message: str) -> None:
    done = grasp_train(*options)
    assert done.returncode == 2
    lines = [line for line in done.stderr.splitlines() if not line.startswith("mc: runs/")]
    assert len(lines) == 1 and message in lines[0], done.stderr
    assert not (grasp_train.folder / "runs").exists()


def test_a_damaged_shard_gives_one_line_and_status_2(two_states: SimpleNamespace, grasp_train: Command) -> None:
    folder = two_states.dataset(grasp_train.folder / "damaged", 10)
    shard = next((folder / "shards").glob("*.parquet"))
    content = bytearray(shard.read_bytes())
    content[len(content) // 2] ^= 1
    shard.write_bytes(content)
    done = grasp_train("--algo", "mc", "--shards", str(folder), *SHORT)
    assert done.returncode == 2 and str(shard) in done.stderr and "Traceback" not in done.stderr
