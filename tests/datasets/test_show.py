import matplotlib.image
import numpy as np
import pytest

from graspq.common.errors import UserError
from graspq.datasets.dataset import Dataset
from graspq.datasets.show import choose_strips, draw_strips, save_strips


def test_strips_hold_the_frames_and_labels_of_their_episodes(dataset, drawn):
    for strip in choose_strips(Dataset.open(dataset), 6, 0):
        episode = drawn.episode(strip.row["episode_id"])
        assert np.array_equal(strip.images, episode.images)
        assert np.array_equal(strip.records["action"], episode.actions)


@pytest.mark.parametrize("success", [True, False])
def test_only_the_outcome_asked_for_is_chosen(dataset, success):
    strips = choose_strips(Dataset.open(dataset), 5, 1, success)
    assert len(strips) == 5
    assert {strip.row["success"] for strip in strips} == {success}


def test_the_choice_is_a_function_of_the_seed(dataset):
    def chosen(seed):
        return [strip.row["episode_id"] for strip in choose_strips(Dataset.open(dataset), 4, seed)]

    assert chosen(0) == chosen(0)
    assert len({tuple(chosen(seed)) for seed in range(5)}) > 1


def test_asking_for_more_than_there_are_gives_all(dataset):
    ids = [strip.row["episode_id"] for strip in choose_strips(Dataset.open(dataset), 100, 0)]
    assert ids == list(range(24))


def test_an_outcome_that_never_happened_is_said(drawn, tmp_path):
    drawn.dataset(tmp_path, blocks=1)
    successes = {drawn.episode(index).success for index in range(2)}
    missing = ({True, False} - successes).pop()
    with pytest.raises(UserError, match=r"there is no (successful|failed) episode"):
        choose_strips(Dataset.open(tmp_path), 2, 0, missing)


def test_every_frame_is_drawn_with_its_reward_and_return(dataset):
    strips = choose_strips(Dataset.open(dataset), 3, 0)
    figure = draw_strips(strips, ("dx", "dy", "dz", "dphi"), "regular grasping")
    frames = [image for axes in figure.axes for image in axes.images]
    assert len(frames) == sum(len(strip.images) for strip in strips)
    texts = [text.get_text() for axes in figure.axes for text in axes.texts]
    last = strips[0].records[-1]
    assert f"r {last['reward']:g}   R {last['mc_return']:.2g}" in texts


def test_the_picture_is_a_png_and_a_place_that_cannot_be_written_is_named(dataset, tmp_path):
    strips = choose_strips(Dataset.open(dataset), 2, 0)
    save_strips(tmp_path / "new/strip.png", strips, ("dx", "dy", "dz", "dphi"), "regular")
    assert matplotlib.image.imread(tmp_path / "new/strip.png").std() > 0.05
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot write the picture"):
        save_strips(tmp_path / "file/strip.png", strips, ("dx", "dy", "dz", "dphi"), "regular")
