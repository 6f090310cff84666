import pytest

from graspq.common.errors import UserError
from graspq.studies.online.settings import OnlineSettings


def test_exploration_falls_linearly_from_one_to_a_twentieth_in_a_hundred_thousand_steps() -> None:
    settings = OnlineSettings()
    points = [settings.exploration(step) for step in (0, 50_000, 100_000, 900_000)]
    assert points == pytest.approx([1.0, 0.525, 0.05, 0.05], abs=1e-12)


def test_all_three_numbers_of_the_schedule_are_settable() -> None:
    settings = OnlineSettings(exploration_start=0.8, exploration_end=0.2, exploration_steps=10)
    assert [settings.exploration(step) for step in (0, 5, 10)] == pytest.approx([0.8, 0.5, 0.2], abs=1e-12)


def test_where_and_how_fast_grasps_are_made_does_not_decide_what_is_collected() -> None:
    assert OnlineSettings(engine="ray", workers=3, checkpoint=7).deciding() == OnlineSettings().deciding()
    assert OnlineSettings(cem_samples=32).deciding() != OnlineSettings().deciding()


def test_more_elites_than_samples_are_refused() -> None:
    with pytest.raises(UserError, match="expected at most as many as samples"):
        OnlineSettings(cem_samples=5)
