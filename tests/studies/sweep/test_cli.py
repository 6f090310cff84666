"""The command: a plan that is only printed, and one line for every mistake."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from graspq.common.files import write_json
from graspq.studies.sweep.cli import described, main
from graspq.studies.sweep.settings import SweepSettings


def grasp_sweep(*words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(words, prog_name="grasp-sweep")
    return int(ended.value.code or 0)


def test_a_dry_run_prints_every_job_and_the_count_and_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    assert grasp_sweep("--preset", "paper", "--dry-run") == 0
    done = capsys.readouterr()
    assert done.out.count("  to do\n") == 540
    assert "540 jobs (54 supervised, 108 dql, 54 mc, 108 corr-mc, 108 ddpg, 108 pcl)" in done.out
    assert "misprint" in done.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--algo", "mc"), "data/regular-10k"),
        (("--preset", "paper", "--algo", "mc", "dql"), "data/regular-100k"),
        (("--algo", "sarsa"), "'sarsa' is unknown"),
        (("--learning-rate", "0"), "--learning-rate: expected numbers above 0"),
        (("--vary", "anneal"), "expected an option of training and its values"),
        (("--algo", "mc", "--vary", "anneal=1"), "--vary anneal: no option of training with mc"),
        (("--steps", "few"), "expected a whole number"),
    ],
)
def test_a_mistake_is_one_line_and_status_two_and_nothing_is_written(
    words: tuple[str, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    assert grasp_sweep(*words) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert said in lines[-1]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["{}", "[", '{"format_version": 2, "jobs": [{}]}'])
def test_a_folder_whose_plan_cannot_be_read_is_refused(text: str, tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "plan.json").write_text(text)
    assert grasp_sweep("--algo", "mc", "--dry-run", "--out", str(tmp_path)) == 2
    assert "plan.json" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--steps", "101"), "holds a sweep with steps = 100, not 101; choose another --out"),
        (("--episodes", "11"), "holds a sweep with episodes = 200, not 11"),
        (("--split", "train"), "holds a sweep with split = validation, not train"),
        (("--preset", "paper", "--steps", "1000"), "holds a sweep with preset = small, not paper"),
    ],
)
def test_a_folder_takes_no_trials_of_another_kind(
    words: tuple[str, ...], said: str, settings: SweepSettings, tmp_path: Path, capsys: Any
) -> None:
    plan = described(dataclasses.replace(settings, episodes=200)) | {"notes": [], "jobs": []}
    write_json(tmp_path / "plan.json", plan)
    given = {"--steps": "100", "--out": str(tmp_path)} | dict(zip(words[::2], words[1::2], strict=True))
    assert grasp_sweep("--algo", "mc", "--dry-run", *(word for pair in given.items() for word in pair)) == 2
    assert said in capsys.readouterr().err
