"""Where the profile says time goes: exclusive, by phase, and the functions as they were afterwards."""

import time
import types

import pytest

from graspq.benchmarks.stopwatch import Stopwatch


def busy(seconds: float) -> None:
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


def test_time_is_booked_once_and_by_the_phase_that_a_call_was_made_in() -> None:
    module, watch = types.SimpleNamespace(), Stopwatch("rest")
    module.native = lambda: busy(0.02)
    module.close = lambda: (module.native(), busy(0.01))
    module.step = lambda: (busy(0.01), module.native(), module.close())
    watch.wrap(module, "step", phase="moving")
    watch.wrap(module, "close", phase="grasping")
    watch.wrap(module, "native", what="physics")
    start = time.thread_time()
    with watch:
        module.step()
        module.native()
    passed = time.thread_time() - start
    assert sum(watch.seconds.values()) == pytest.approx(passed, abs=2e-3)
    expected = {
        ("moving", "Python"): 0.01,
        ("grasping", "Python"): 0.01,
        ("moving", "physics"): 0.02,
        ("grasping", "physics"): 0.02,
        ("rest", "physics"): 0.02,
    }
    assert {place: watch.seconds[place] for place in expected} == pytest.approx(expected, abs=2e-3)


def test_functions_are_as_before_also_when_one_raised() -> None:
    def fail() -> None:
        raise KeyError("no")

    module, watch = types.SimpleNamespace(fail=fail), Stopwatch("rest")
    watch.wrap(module, "fail", phase="failing")
    with pytest.raises(KeyError), watch:
        module.fail()
    assert module.fail is fail
