"""The engine on this machine, with workers that really die."""

import itertools
import multiprocessing
import signal

import pytest
from ending import end_in_the_middle, opened
from units_of_work import Squares, TooLarge

from graspq.common.errors import MachineError, UserError
from graspq.engine import EngineSettings, run


def local(workers):
    return EngineSettings(workers=workers)


def children():
    return multiprocessing.active_children()


@pytest.mark.parametrize("workers", [0, 1, 2])
def test_every_unit_comes_back_once_with_its_result(workers):
    assert sorted(run(Squares(), range(20), local(workers))) == [(number, number**2) for number in range(20)]


def test_a_worker_opens_its_work_once_and_leaves_it_in_the_end(tmp_path):
    list(run(Squares(tmp_path), range(10), local(2)))
    assert len(opened(tmp_path)) == len(list(tmp_path.glob("open-*"))) == len(list(tmp_path.glob("close-*"))) <= 2


def test_units_are_fetched_as_workers_get_free():
    fetched = []
    units = (fetched.append(number) or number for number in itertools.count())
    results = run(Squares(), units, local(2))
    assert [next(results)[1] for _ in range(5)] and len(fetched) <= 5 + 2 + 2
    results.close()
    assert not children()


def test_workers_are_renewed_after_some_units(tmp_path):
    list(run(Squares(tmp_path), range(6), local(1), units_per_worker=2))
    assert len(opened(tmp_path)) == 3


@pytest.mark.parametrize("how", ["die once", "interrupted once"])
def test_a_unit_whose_worker_is_killed_or_asked_to_end_is_done_by_another(how, tmp_path):
    units = [1, (how, str(tmp_path / "mark")), 2, 3]
    assert sorted(result for _, result in run(Squares(), units, local(2))) == [0, 1, 4, 9]


def test_a_unit_that_kills_two_workers_is_named_after_all_others_are_done():
    results = []
    with pytest.raises(UserError, match=r"^unit 'die' \(killed by SIGKILL\), unit 'exit' \(exit code 7\) ended their"):
        for _, result in run(Squares(), [1, "die", "exit", 2, 3, 4], local(2), name=lambda unit: f"unit {unit!r}"):
            results.append(result)
    assert sorted(results) == [1, 4, 9, 16] and not children()


def test_where_every_unit_ends_its_worker_the_first_few_are_enough():
    with pytest.raises(UserError, match="no unit could be done"):
        list(run(Squares(), ["die"] * 1000, local(2)))


@pytest.mark.parametrize("workers", [0, 2])
def test_a_mistake_of_the_user_is_the_same_one_in_the_parent(workers):
    with pytest.raises(UserError) as raised:
        list(run(Squares(), ["mistake", ("sleep", 0.1)], local(workers)))
    assert raised.value.message == "--size: a mistake of the user's; choose another" and not children()


@pytest.mark.parametrize("workers", [0, 2])
def test_a_failure_of_the_machine_is_one_in_the_parent_too_and_no_mistake_of_the_user(workers):
    with pytest.raises(MachineError) as raised:
        list(run(Squares(), ["full", ("sleep", 0.1)], local(workers)))
    assert raised.value.message == "data: the disk is full" and not isinstance(raised.value, UserError)


def test_too_little_memory_for_the_unit_itself_is_a_failure_of_the_machine_without_a_traceback(capfd):
    with pytest.raises(MachineError, match="not enough memory"):
        list(run(Squares(), [TooLarge()], local(1)))
    assert "Traceback" not in capfd.readouterr().err


def test_a_defect_carries_its_traceback():
    with pytest.raises(RuntimeError, match=r"(?s)unit defect failed.*in square.*ZeroDivisionError: deep in a worker"):
        list(run(Squares(), ["defect"], local(1), name=lambda unit: f"unit {unit}"))
    with pytest.raises(RuntimeError, match=r"failed in a worker:\n.*pickle"):
        list(run(Squares(), [lambda: None], local(1), name=lambda unit: "a function"))


def test_workers_that_are_ended_while_they_send_a_large_result_are_not_waited_for():
    for _ in range(5):
        results = run(Squares(), itertools.repeat(("large", 30_000_000)), local(2))
        next(results)
        results.close()
    assert not children()


def test_an_error_of_the_caller_leaves_no_process():
    def consume():
        for _ in run(Squares(), [1, ("sleep", 60)], local(2)):
            raise KeyError("of the caller")

    with pytest.raises(KeyError):
        consume()
    assert not children()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_nothing_is_left_of_a_process_that_is_ended(tmp_path, number):
    end_in_the_middle("local", number, tmp_path)


def test_an_address_is_for_ray():
    with pytest.raises(UserError, match=r"--ray-address: 'auto' is for --engine ray"):
        EngineSettings(ray_address="auto")
