"""Where the profile says time goes: exclusive, by phase, and the functions as they were afterwards."""

import sys
import time
import types
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def stopwatch(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from phases import Stopwatch

    yield Stopwatch
    sys.modules.pop("phases", None)


def busy_module():
    module = types.SimpleNamespace()
    module.native = lambda: time.sleep(0.02)
    module.close = lambda: (module.native(), time.sleep(0.01))
    module.step = lambda: (time.sleep(0.01), module.native(), module.close())
    return module


def test_time_is_booked_once_and_by_the_phase_that_a_call_was_made_in(stopwatch):
    module, watch = busy_module(), stopwatch("rest")
    watch.as_phase(module, "step", "moving")
    watch.as_phase(module, "close", "grasping")
    watch.as_part(module, "native", "physics")
    start = time.perf_counter()
    with watch:
        module.step()
        module.native()
    passed = time.perf_counter() - start
    assert watch.calls == {
        ("moving", "Python"): 1,
        ("grasping", "Python"): 1,
        ("moving", "physics"): 1,
        ("grasping", "physics"): 1,
        ("rest", "physics"): 1,
    }
    assert sum(watch.seconds.values()) == pytest.approx(passed, abs=1e-3)
    for place in (("moving", "physics"), ("grasping", "physics"), ("rest", "physics")):
        assert watch.seconds[place] >= 0.02
    for place in (("moving", "Python"), ("grasping", "Python")):
        assert watch.seconds[place] >= 0.01
    # Sleeping takes no CPU time.
    assert sum(watch.core_seconds.values()) < 0.02


def test_functions_are_as_before_after_unwrapping_also_when_one_raised(stopwatch):
    def fail():
        raise KeyError("no")

    module, watch = types.SimpleNamespace(fail=fail), stopwatch("rest")
    watch.as_phase(module, "fail", "failing")
    with pytest.raises(KeyError), watch:
        module.fail()
    watch.unwrap()
    assert module.fail is fail
    assert watch.calls == {("failing", "Python"): 1}
