import shutil
from pathlib import Path

import pytest

from graspq.common.checksums import read_checked_json, write_checked_json
from graspq.studies.online.cli import main


def called(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[object, str, str]:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments], prog_name="grasp-online")
    out, err = capsys.readouterr()
    return ended.value.code, out, err


def test_a_run_ends_with_one_line_on_rounds_and_success(
    capsys: pytest.CaptureFixture[str], start: Path, tmp_path: Path
) -> None:
    small = ("--rounds", 2, "--grasps", 2, "--steps-per-round", 2, "--workers", 0)
    code, out, err = called(capsys, "--start", start, "--out", tmp_path / "run", *small)
    assert code == 0, err
    assert out.startswith(f"{tmp_path / 'run'}; step 10; 2 rounds, 4 grasps, success rate ")
    assert "round 2 of 2, step 8: 2 grasps, exploration 1.000" in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--start", "nowhere"), "nowhere"),
        (("--algo", "mc", "--steps", "5"), "No such option: --steps"),
        (("--algo", "mc", "--anneal", "0.5"), "--anneal belongs to --algo corr-mc"),
        ((), "--algo: is needed from scratch; give it, or a run to go on from with --start"),
        (("--rounds", "0"), "--rounds: expected a number of at least 1, got 0"),
        (("--grasps", "none"), "'none' is not a valid integer"),
        (("--steps-per-round", "-1"), "expected a whole number of at least 1"),
        (("--exploration-end", "2"), "--exploration-end: expected a number of at least 0 and at most 1, got 2"),
        (("--algo", "mc", "--shards", "nowhere"), "nowhere: no such folder or file"),
    ],
)
def test_nonsense_is_one_line_and_status_two_and_writes_nothing(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    code, _, err = called(capsys, "--out", tmp_path / "never", *arguments)
    assert code == 2 and message in err
    assert len([line for line in err.strip().splitlines() if "never" not in line]) == 1, err
    assert not (tmp_path / "never").exists()


def test_the_help_shows_the_rounds_and_the_options_of_the_start_runs_estimator(
    capsys: pytest.CaptureFixture[str], start: Path
) -> None:
    code, out, _ = called(capsys, "--start", start, "--help")
    assert code == 0 and out.index("--exploration-start") < out.index("--batch-size") < out.index("--lag-steps")
    assert "Options of --algo dql:" in out and "Options of --network paper:" in out and "--steps " not in out


def test_data_of_another_task_are_refused(capsys: pytest.CaptureFixture[str], start: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(start, tmp_path / "other")
    config = read_checked_json(copy / "config.json", "run", "")
    config["dataset"]["task"]["trigger_height"] = 0.5
    write_checked_json(copy / "config.json", config)
    code, _, err = called(capsys, "--start", copy, "--out", tmp_path / "never")
    assert code == 2 and "of another task than that of" in err and not (tmp_path / "never").exists()
