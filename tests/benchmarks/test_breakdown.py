"""The tables of where the time goes."""

from breakdown import grasp_rows, section, step_rows

PROFILE = [
    {"phase": "rendering", "what": "TinyRenderer", "CPU ms a grasp": 2.0},
    {"phase": "moving", "what": "physics", "CPU ms a grasp": 5.0},
    {"phase": "moving", "what": "IK", "CPU ms a grasp": 0.5},
    {"phase": "moving", "what": "motor commands", "CPU ms a grasp": 1.5},
    {"phase": "moving", "what": "Python", "CPU ms a grasp": 1.0},
    {"phase": "all", "what": "", "CPU ms a grasp": 10.0},
]
STEP = [{"estimator": "mc", "step, ms": 100.0, "backward, ms": 60.0, "share of forward and backward": 0.9}]


def test_the_phases_of_a_grasp_are_summed_and_sorted_and_their_shares_make_a_whole() -> None:
    moving, rendering = grasp_rows({"Where a grasp's time goes": PROFILE})
    assert (moving["phase of a grasp"], moving["CPU ms"], moving["share"]) == ("moving", 8.0, "80%")
    assert (moving["PyBullet"], moving["IK and motors"], moving["Python"]) == (5.0, 2.0, 1.0)
    assert (rendering["phase of a grasp"], rendering["share"], rendering["Python"]) == ("rendering", "20%", 0.0)


def test_a_step_is_shown_in_milliseconds_and_its_shares_in_percent() -> None:
    (row,) = step_rows({"where a step of ours goes, medians": STEP})
    assert row == {
        "estimator": "mc",
        "step (ms)": 100.0,
        "backward (ms)": 60.0,
        "share of forward and backward": "90%",
    }


def test_the_section_shows_what_was_measured_alone() -> None:
    assert section({}) == ""
    shown = section({"training": {"where a step of ours goes, medians": STEP}})
    assert "training step" in shown and "A grasp" not in shown
