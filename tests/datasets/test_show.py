import matplotlib.image
import numpy as np
import pytest

from graspq.common.errors import UserError
from graspq.datasets.labels import mc_return
from graspq.datasets.show import choose_episodes, draw_strips, save_strips


@pytest.mark.parametrize("success", [True, False])
def test_only_the_outcome_asked_for_is_chosen(dataset, success):
    episodes = choose_episodes(dataset, 5, 1, success)
    assert [episode.success for episode in episodes] == [success] * 5


def test_the_episodes_are_those_that_were_collected(dataset, drawn):
    for episode in choose_episodes(dataset, 6, 0):
        expected = drawn.episode(episode.episode_id)
        assert np.array_equal(episode.images, expected.images) and np.array_equal(episode.actions, expected.actions)


def test_the_choice_is_a_function_of_the_seed(dataset):
    def chosen(seed):
        return [episode.episode_id for episode in choose_episodes(dataset, 4, seed)]

    assert chosen(0) == chosen(0)
    assert len({tuple(chosen(seed)) for seed in range(5)}) > 1


def test_asking_for_more_than_there_are_gives_all(dataset):
    ids = [episode.episode_id for episode in choose_episodes(dataset, 100, 0)]
    assert ids == list(range(24))


def test_an_outcome_that_never_happened_is_said(drawn, tmp_path):
    drawn.dataset(tmp_path, blocks=1)
    successes = {drawn.episode(index).success for index in range(2)}
    missing = ({True, False} - successes).pop()
    with pytest.raises(UserError, match=r"there is no (successful|failed) episode"):
        choose_episodes(tmp_path, 2, 0, missing)


def test_every_frame_is_drawn_with_its_reward_and_return(dataset, drawn):
    episodes = choose_episodes(dataset, 3, 0)
    figure = draw_strips(episodes, drawn.manifest(discount=0.5), "regular grasping")
    frames = [image for axes in figure.axes for image in axes.images]
    assert len(frames) == sum(episode.steps for episode in episodes)
    texts = [text.get_text() for axes in figure.axes for text in axes.texts]
    for episode in episodes:
        first = mc_return(episode.rewards, 0.5)[0]
        assert f"r {episode.rewards[0]:g}   R {first:.2g}" in texts


def test_the_picture_is_a_png_and_a_place_that_cannot_be_written_is_named(dataset, tmp_path, drawn):
    episodes = choose_episodes(dataset, 2, 0)
    save_strips(tmp_path / "new/strip.png", episodes, drawn.manifest(), "regular")
    assert matplotlib.image.imread(tmp_path / "new/strip.png").std() > 0.05
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot write the picture"):
        save_strips(tmp_path / "file/strip.png", episodes, drawn.manifest(), "regular")
