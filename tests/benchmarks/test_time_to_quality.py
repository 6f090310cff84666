import pytest
from time_to_quality import Clock, Mark, first_reached, next_validation, row_of

from graspq.common.errors import UserError


def test_validations_come_every_so_many_transitions_and_later_every_two_per_cent():
    assert next_validation(0, 256, 6400) == 25
    assert next_validation(0, 32, 6400) == 200
    assert next_validation(100_000, 32, 6400) == 102_000


def test_the_bar_is_met_by_the_first_validation_that_is_good_enough():
    marks = [Mark(1, 1.0, 1.0, 0.7), Mark(2, 2.0, 2.0, 0.75), Mark(3, 3.0, 3.0, 0.8)]
    assert first_reached(marks, 0.75) == marks[1]
    assert first_reached(marks, 0.81) is None


def test_a_clock_goes_on_from_the_validation_that_its_run_is_at(tmp_path):
    path = tmp_path / "run" / "clock.jsonl"
    clock = Clock(path, 0)
    for step in (10, 20):
        clock.start()
        clock.stop()
        clock.note(step, 0.5 + step / 100)
    resumed = Clock(path, 10)
    assert resumed.marks == clock.marks[:1]
    assert resumed.seconds == clock.marks[0].seconds > 0
    assert Clock(path, 10).marks == resumed.marks


def test_a_run_without_its_times_is_refused(tmp_path):
    with pytest.raises(UserError, match="no time of step 10"):
        Clock(tmp_path / "clock.jsonl", 10)


def test_a_rival_that_never_met_the_bar_is_shown_as_more_than_its_time():
    ours = Mark(25, 3.0, 5.0, 0.76)
    row = row_of("paper", 0, 32, 60.0, ours)
    assert row["times ours"] == "> 20"
    assert row["seconds"] == "> 60"
    assert row_of("default", 0, 256, ours, ours)["times ours"] == 1.0
