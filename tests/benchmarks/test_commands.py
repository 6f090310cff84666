"""The commands of the two benchmarks: a mistake is one line and exit status 2."""

import importlib
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.mark.parametrize(
    ("script", "arguments", "said"),
    [
        ("collection", ["--turns", "0"], "--turns"),
        ("collection", ["--part", "speed"], "'speed'"),
        ("collection", ["--objects", "nowhere"], "nowhere"),
        ("evaluation", [], "RUN"),
        ("evaluation", ["nowhere"], "nowhere"),
        ("evaluation", ["nowhere", "--episodes", "0"], "--episodes"),
    ],
)
def test_a_mistake_is_one_line_and_exit_status_2(monkeypatch, capsys, tmp_path, script, arguments, said):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(script).main.main(arguments, prog_name=script)
    assert ended.value.code == 2
    printed = capsys.readouterr().err
    assert len(printed.splitlines()) == 1
    assert said in printed
