"""Turns, ratios and bars; and calls in processes of their own."""

import json
import mmap
import os
import time
from collections.abc import Callable
from functools import partial

import pytest
import torch

from graspq.benchmarks.harness import (
    Ratio,
    Result,
    TurnsSettings,
    alone,
    apart,
    check_equal,
    command,
    compared,
    median_ratio,
    resident_bytes,
    take_turns,
    timed,
)
from graspq.common.errors import UserError


def test_rivals_take_turns_and_every_other_turn_is_backwards() -> None:
    order: list[str] = []

    def rival(name: str) -> Callable[[int], int]:
        return lambda turn: order.append(name) or turn

    assert take_turns({"a": rival("a"), "b": rival("b")}, 3) == {"a": [0, 1, 2], "b": [0, 1, 2]}
    assert "".join(order) == "baabbaab"
    assert take_turns({"a": rival("a")}, 1, warm_up=False) == {"a": [0]} and len(order) == 9


def test_a_rival_takes_the_seconds_of_a_unit() -> None:
    assert 0.01 <= timed(lambda: time.sleep(0.05), 5)(0) < 0.05
    fast, slow = compared("rival", "sample", {"ours": [0.01, 0.02], "png": [0.1, 0.3]}, "png")
    assert fast == {"rival": "ours", "ms each": 15, "samples a second": pytest.approx(1 / 0.015), "times png": 12.5}
    assert slow["times png"] == 1


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


def test_calls_are_made_each_in_a_process_of_its_own() -> None:
    processes = apart(partial(os.getpid), partial(os.getpid))
    assert len({os.getpid(), alone(os.getpid), *processes}) == 4 and alone(divmod, 7, 2) == (3, 1)


def test_a_rival_that_computes_something_else_is_refused() -> None:
    ours = torch.tensor([0.5, 0.5])
    near = {"near": torch.tensor([0.5, 0.49995]), "equal": ours}
    check_equal(ours, near)
    for value, shown in ((0.6, "0.1"), (float("nan"), "nan")):
        with pytest.raises(UserError, match=f"broken: differs from ours by {shown}"):
            check_equal(ours, {"broken": torch.tensor([0.5, value])})


def test_memory_is_that_of_this_process() -> None:
    before = resident_bytes()
    with mmap.mmap(-1, 50_000_000) as pages:
        pages.write(bytes(50_000_000))
        assert resident_bytes() - before > 40_000_000


def test_a_command_prints_what_it_measured_and_returns_it(capsys: pytest.CaptureFixture[str]) -> None:
    result = Result([Ratio("x", 2.0)], {"Rows": [{"name": "a", "number": 0.12345}]}, {"threads": 2})
    main = command(TurnsSettings, lambda settings: result)
    found = json.loads(json.dumps(main.invoke(main.make_context("x", []))))
    shown = capsys.readouterr().out
    assert "| a | 0.123 |" in shown and "| x | 2 |  |  |  |" in shown
    assert Ratio(**found["ratios"][0]) == result.ratios[0] and found["tables"] == result.tables
    assert found["measured"]["versions"]["torch"] and found["threads"] == 2 and found["settings"] == {"turns": 5}
