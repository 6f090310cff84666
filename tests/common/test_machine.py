import os

from graspq.common.machine import available_cores


def test_the_cores_are_at_least_one_and_at_most_those_of_the_machine():
    assert 1 <= available_cores() <= (os.cpu_count() or 1)
