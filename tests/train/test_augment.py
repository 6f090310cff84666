"""Augmentation: what moves, what is mirrored and what stays."""

import torch

from graspq.train.augment import augmented, recolored
from graspq.train.batch import Batch
from graspq.train.state import seeded
from graspq.train.views import mirrored_action, shifted

SIGNS = (1, -1, 1, -1)


def batch_of(count: int, size: int = 12, steps: int = 1) -> Batch:
    generator = seeded("tests/augment", count)
    image = torch.randint(0, 256, (count, steps, size, size, 3), dtype=torch.uint8, generator=generator)
    action = torch.rand(count, steps, 4, generator=generator) * 2 - 1
    zero = torch.zeros(count, steps)
    return Batch(
        image=image,
        step=zero.long(),
        action=action,
        reward=zero,
        terminal=zero.bool(),
        mc_return=zero,
        synthetic_action=action * 2,
        next_image=image.clone(),
        next_step=zero.long(),
    )


def test_a_shift_moves_pixels_and_repeats_the_border() -> None:
    image = torch.arange(16, dtype=torch.uint8).view(1, 1, 4, 4, 1)
    moved = shifted(image, torch.tensor([[1, -2]]), torch.tensor([False])).view(4, 4)
    assert moved.tolist() == [[4, 4, 4, 5], [8, 8, 8, 9], [12, 12, 12, 13], [12, 12, 12, 13]]


def test_mirroring_reverses_the_columns_of_images() -> None:
    batch = batch_of(4)
    mirrored = torch.tensor([True, False, True, False])
    image = shifted(batch.image, torch.zeros(4, 2, dtype=torch.int64), mirrored)
    for index, flip in enumerate(mirrored.tolist()):
        expected = batch.image[index].flip(2) if flip else batch.image[index]
        assert torch.equal(image[index], expected)


def test_mirroring_negates_dy_and_dphi_and_undoes_itself() -> None:
    action = torch.tensor([[[0.1, 0.2, 0.3, 0.4]], [[0.1, 0.2, 0.3, 0.4]]])
    mirrored = torch.tensor([True, False])
    once = mirrored_action(action, mirrored, SIGNS)
    torch.testing.assert_close(once[0, 0], torch.tensor([0.1, -0.2, 0.3, -0.4]))
    assert torch.equal(once[1], action[1])
    assert torch.equal(mirrored_action(once, mirrored, SIGNS), action)


def test_images_and_actions_of_a_sample_are_mirrored_together_and_about_half_of_them() -> None:
    batch = batch_of(400)
    result = augmented(batch, 0, SIGNS, seeded("tests/draws"))
    flipped_image = (result.image == batch.image.flip(3)).flatten(1).all(1)
    flipped_action = (result.action[..., 1] == -batch.action[..., 1]).flatten()
    assert torch.equal(flipped_image, flipped_action)
    assert torch.equal(result.synthetic_action, result.action * 2)
    assert 150 < int(flipped_image.sum()) < 250


def test_a_state_and_its_successor_are_changed_alike() -> None:
    result = augmented(batch_of(32), 4, SIGNS, seeded("tests/draws"), 0.3)
    assert result.next_image is not None
    assert torch.equal(result.image, result.next_image)


def test_all_steps_of_an_episode_are_changed_alike() -> None:
    batch = batch_of(8, steps=3)
    batch.image[:] = batch.image[:, :1].clone()
    result = augmented(batch, 4, SIGNS, seeded("tests/draws"), 0.3)
    assert torch.equal(result.image[:, 0], result.image[:, 2])
    assert not torch.equal(result.image, batch.image)


def test_other_colours_are_those_of_the_formula() -> None:
    image = torch.tensor([[10, 100, 250], [0, 1, 2]], dtype=torch.uint8).view(2, 1, 1, 1, 3)
    order = torch.tensor([[2, 0, 1], [0, 1, 2]])
    gain, bias = torch.tensor([[1.0, 1.5, 0.7], [1.0, 1.0, 1.0]]), torch.tensor([[18.0, 0.0, -9.5], [-1.0, 0.0, 0.0]])
    assert recolored(image, order, gain, bias).flatten().tolist() == [255, 15, 60, 0, 1, 2]
    # Episodes that are cut to the longest of a batch.
    cut = image.expand(2, 5, 1, 2, 3).clone()[:, :3]
    assert torch.equal(recolored(cut, order, gain, bias)[:, 2, 0, 1], recolored(image, order, gain, bias)[:, 0, 0, 0])


def test_colours_change_by_as_much_as_is_asked_and_places_by_nothing() -> None:
    batch = batch_of(300)
    batch.image[:] = torch.tensor([50, 100, 200], dtype=torch.uint8)
    plain, result = (augmented(batch, 4, SIGNS, seeded("tests/draws"), color) for color in (0.0, 0.3))
    assert torch.equal(plain.action, result.action)
    levels = result.image[:, 0, 0, 0]
    order = levels.argsort(1)
    assert len(torch.unique(order, dim=0)) == 6 and torch.equal(plain.image, batch.image)
    darkest, brightest = levels.amin(1), levels.amax(1)
    assert 17 <= int(darkest.min()) < 27 and 73 < int(darkest.max()) <= 83, "50 times 0.7 to 1.3, 18 less or more"
    assert 122 <= int(brightest.min()) < 140 and int(brightest.max()) == 255


def test_shifts_reach_but_do_not_exceed_the_limit() -> None:
    size = 12
    ramp = torch.arange(size, dtype=torch.uint8).view(1, 1, size, 1, 1).expand(300, 1, size, size, 3).contiguous()
    batch = batch_of(300, size)
    batch.image[:] = ramp
    result = augmented(batch, 4, None, seeded("tests/draws"))
    moved = result.image[:, 0, 6, 0, 0].int() - 6
    assert sorted(set(moved.tolist())) == list(range(-4, 5))


def test_no_augmentation_changes_nothing() -> None:
    batch = batch_of(8)
    result = augmented(batch, 0, None, seeded("tests/draws"))
    assert torch.equal(result.image, batch.image) and torch.equal(result.action, batch.action)
