"""A real sweep: stopped by a signal, killed, gone on with; one of its jobs diverges."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from graspq.common.files import locked
from graspq.studies.sweep.cli import main
from graspq.train.run import Run

ID, DIVERGING = "mc-lr0.001-width4-seed0", "mc-lr1e+30-width4-seed0"


def wait_for(path: Path, process: "subprocess.Popen[bytes]") -> None:
    until = time.monotonic() + 300
    while not path.exists():
        assert process.poll() is None and time.monotonic() < until
        time.sleep(0.02)


@pytest.mark.slow
def test_a_sweep_that_is_stopped_and_killed_goes_on_where_it_was_and_a_failure_stops_nothing(
    dataset: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ["--algo", "mc", "--learning-rate", "0.001", "1e30", "--width", "4", "--shards", str(dataset)]
    words += ["--steps", "600", "--episodes", "2", "--workers", "2", "--threads", "1", "--device", "cpu"]
    words += ["--out", str(tmp_path)]
    sweep = [str(Path(sys.executable).with_name("grasp-sweep")), *words]

    # A shell that starts the tests in the background lets them ignore SIGINT, and what they start would too.
    process = subprocess.Popen(sweep, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    wait_for(tmp_path / "logs" / f"{ID}.log", process)
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=120) == 130
    assert not (tmp_path / "failures").exists()

    process = subprocess.Popen(sweep)
    wait_for(tmp_path / "runs" / ID / "config.json", process)
    process.kill()
    process.wait()
    capfd.readouterr()
    time.sleep(5)
    with locked(tmp_path, "test"), locked(tmp_path / "runs" / ID, "test"):  # free: nothing of the killed sweep lives on
        pass

    with pytest.raises(SystemExit) as ended:
        main(words, prog_name="grasp-sweep")
    out, err = capfd.readouterr()
    assert ended.value.code == 1
    rows = {row["id"]: row for row in map(json.loads, (tmp_path / "sweep.jsonl").read_text().splitlines())}
    assert [(row["status"], row["steps"], row["episodes"]) for row in rows.values()] == [
        ("done", 600, 2),
        ("failed", 0, None),
    ]
    assert rows[DIVERGING]["reason"].startswith("mc diverged at step ")
    assert out.count("\n") == 4 and "failed: mc diverged" in out
    assert "[2/2] " in err and "step/s" not in err
    logged = [row["step"] for row in Run.open(tmp_path / "runs" / ID).metrics() if "loss" in row]
    assert logged == sorted(set(logged)) and logged[-1] == 600

    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").rglob("*") if path.is_file()}
    with pytest.raises(SystemExit) as ended:
        main(words, prog_name="grasp-sweep")
    assert ended.value.code == 1
    assert "2 of 2 jobs finished before" in capfd.readouterr().err
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").rglob("*") if path.is_file()}
