"""Turns, ratios and bars; and calls in processes of their own."""

import json
import mmap
import os
import time
from pathlib import Path

import pytest
import torch

from graspq.benchmarks.measuring import (
    Call,
    Ratio,
    Result,
    TurnsSettings,
    apart,
    command,
    greatest_difference,
    median_ratio,
    resident_bytes,
    take_turns,
)
from graspq.common.errors import UserError


def test_rivals_take_turns_and_every_other_turn_is_backwards() -> None:
    order: list[str] = []
    seconds = take_turns({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 3)
    assert "".join(order) == "baabbaab"
    assert {name: len(values) for name, values in seconds.items()} == {"a": 3, "b": 3}


def test_a_slow_turn_of_all_rivals_does_not_move_the_ratio() -> None:
    assert median_ratio([2.0, 20.0, 2.2], [1.0, 10.0, 1.0]) == 2.0


@pytest.mark.parametrize(
    ("ratio", "row"),
    [
        (Ratio("x", 12.34, bar=10, aim=30), ["x", "12.3", "≥ 10", "30", "yes"]),
        (Ratio("x", 9.83, bar=10), ["x", "9.83", "≥ 10", "", "**no**"]),
        (Ratio("x", 0.051, bar=0.05, aim=0.01, is_share=True), ["x", "5.1%", "≤ 5.0%", "1.0%", "**no**"]),
        (Ratio("x", 0.004, bar=0.02, is_share=True), ["x", "0.4%", "≤ 2.0%", "", "yes"]),
        (Ratio("x", "at least 20", bar=5), ["x", "at least 20", "≥ 5", "", "yes"]),
        (Ratio("… y", 1.5), ["… y", "1.5", "", "", ""]),
        (Ratio("x", None, bar=5), ["x", "not measured", "", "", ""]),
    ],
)
def test_a_line_of_the_table_says_whether_its_bar_was_met(ratio: Ratio, row: list[str]) -> None:
    assert ratio.row() == row


def test_calls_are_made_one_after_the_other_each_in_a_process_of_its_own() -> None:
    processes = list(apart([Call(os.getpid), Call(os.getpid), Call(time.sleep, (0,))]))
    assert len({os.getpid(), *processes[:2]}) == 3 and processes[2] is None


def test_a_rival_that_computes_something_else_is_refused() -> None:
    ours = torch.tensor([0.5, 0.5])
    near = {"near": torch.tensor([0.5, 0.49995]), "equal": ours}
    assert greatest_difference(ours, near) == pytest.approx(5e-5, rel=1e-2)
    for value, shown in ((0.6, "0.1"), (float("nan"), "nan")):
        with pytest.raises(UserError, match=f"broken: differs from ours by {shown}"):
            greatest_difference(ours, {"broken": torch.tensor([0.5, value])})


def test_memory_is_that_of_this_process() -> None:
    before = resident_bytes()
    with mmap.mmap(-1, 50_000_000) as pages:
        pages.write(bytes(50_000_000))
        assert resident_bytes() - before > 40_000_000


def test_a_command_prints_and_writes_what_it_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = Result([Ratio("x", 2.0)], {"Rows": [{"name": "a", "number": 0.12345}]}, {"threads": 2})
    main = command(TurnsSettings, lambda settings: result)
    with pytest.raises(SystemExit) as ended:
        main.main(["--out", str(tmp_path / "out.json")])
    assert ended.value.code == 0
    assert "| a | 0.123 |" in capsys.readouterr().out
    found = json.loads((tmp_path / "out.json").read_text())
    assert Ratio(**found["ratios"][0]) == result.ratios[0] and found["tables"] == result.tables
    assert found["measured"]["versions"]["torch"] and found["threads"] == 2 and found["settings"] == {"turns": 5}
