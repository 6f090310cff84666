"""Stochastic search on Q-functions whose best action is known."""

import pytest
import torch
from plain import ACTION
from torch import Tensor

from graspq.train.selection import (
    SearchSpace,
    best_of,
    cross_entropy_method,
    single_steps,
    uniform_actions,
)
from graspq.train.state import seeded

SPACE = single_steps(ACTION, torch.zeros(1))
# Within reach of where the search starts, dz = -1.
CENTRES = torch.tensor([[0.3, -0.4, -0.7, 0.4], [-0.2, 0.3, -0.9, 0.0]])
FALSE_PEAK = torch.tensor([0.5, 0.5, -0.8, 0.5])


def cem_noise(generator: torch.Generator, batch: int, iterations: int = 3, samples: int = 64) -> Tensor:
    return torch.randn(iterations, batch, samples, 4, generator=generator)


def quadratic(action: Tensor) -> Tensor:
    """Q of two states whose best actions are `CENTRES`."""
    return 1 - (action - CENTRES.unsqueeze(1)).square().sum(-1)


def test_the_cross_entropy_method_finds_the_maximum_of_a_quadratic() -> None:
    errors = []
    for seed in range(20):
        choice = cross_entropy_method(quadratic, cem_noise(seeded("tests/cem", seed), batch=2), SPACE)
        errors.append((choice.action - CENTRES).abs().amax())
    assert torch.stack(errors).mean() < 0.15
    many = cem_noise(seeded("tests/cem", 0), batch=2, iterations=12, samples=256)
    torch.testing.assert_close(
        cross_entropy_method(quadratic, many, SPACE, elites=24).action, CENTRES, rtol=0, atol=0.01
    )


def test_the_cross_entropy_method_reaches_a_maximum_on_the_border_and_stays_inside() -> None:
    def beyond(action: Tensor) -> Tensor:
        assert float(action.abs().max()) <= 1.0
        return -(action - 2).square().sum(-1)

    choice = cross_entropy_method(beyond, cem_noise(seeded("tests/cem"), batch=1, iterations=10), SPACE)
    torch.testing.assert_close(choice.action, torch.ones(1, 4), rtol=0, atol=0.02)


def test_the_cross_entropy_method_returns_the_best_sample_of_the_last_iteration_where_asked() -> None:
    asked: list[Tensor] = []

    def falling(action: Tensor) -> Tensor:
        asked.append(action)
        return quadratic(action) - len(asked)  # so that the best of all is one of the first iteration

    choice = cross_entropy_method(falling, cem_noise(seeded("tests/cem"), batch=2), SPACE, answer="last")
    assert len(asked) == 3
    assert torch.equal(choice.action, asked[-1][torch.arange(2), quadratic(asked[-1]).argmax(dim=1)])
    assert torch.equal(choice.q, quadratic(asked[-1]).amax(1) - 3)


def test_the_cross_entropy_method_returns_the_best_sample_it_has_met_where_asked() -> None:
    met: list[Tensor] = []

    def remembered(action: Tensor) -> Tensor:
        met.append(quadratic(action))
        return met[-1]

    choice = cross_entropy_method(remembered, cem_noise(seeded("tests/cem"), batch=2), SPACE, answer="best")
    assert [list(q.shape) for q in met] == [[2, 64]] * 3
    assert torch.equal(choice.q, torch.cat(met, dim=1).amax(1))
    assert torch.equal(quadratic(choice.action.unsqueeze(1)).squeeze(1), choice.q)


def test_the_mean_of_the_elites_is_not_drawn_to_a_narrow_false_peak() -> None:
    def with_a_false_peak(action: Tensor) -> Tensor:
        return quadratic(action) + 2.0 * ((action - FALSE_PEAK).abs().amax(-1) < 0.2)

    wrong = {"mean": 0, "best": 0}
    for answer in wrong:
        for seed in range(40):
            noise = cem_noise(seeded("tests/cem", seed), batch=2)
            action = cross_entropy_method(with_a_false_peak, noise, SPACE, answer=answer).action
            wrong[answer] += int(((action - FALSE_PEAK).abs().amax(-1) < 0.2).sum())
    assert wrong["mean"] < wrong["best"]


def test_the_first_iteration_is_centred_straight_down_and_clipped() -> None:
    seen: list[Tensor] = []

    def remembered(action: Tensor) -> Tensor:
        seen.append(action)
        return action.sum(-1)

    cross_entropy_method(remembered, cem_noise(seeded("tests/cem"), batch=1, samples=20_000), SPACE)
    dx, _, dz, dphi = seen[0][0].unbind(-1)
    assert float(seen[0].abs().max()) <= 1
    assert abs(float((dz == -1).float().mean()) - 0.5) < 0.02
    for free in (dx, dphi):
        assert abs(float(free.mean())) < 0.02
        assert abs(float((free.abs() < 0.5).float().mean()) - 0.6827) < 0.02


def test_the_choice_of_a_state_does_not_depend_on_the_others_in_its_batch() -> None:
    noise = cem_noise(seeded("tests/cem"), batch=2)
    both = cross_entropy_method(quadratic, noise, SPACE)
    alone = cross_entropy_method(lambda action: quadratic(action.expand(2, -1, -1))[1:], noise[:, 1:], SPACE)
    assert torch.equal(both.action[1:], alone.action)


def test_the_best_of_uniform_candidates_comes_with_its_q() -> None:
    candidates = uniform_actions(seeded("tests/uniform"), batch=2, candidates=500, dimensions=4)
    assert candidates.shape == (2, 500, 4)
    assert -1 <= float(candidates.min()) < -0.99 and 0.99 < float(candidates.max()) <= 1
    choice = best_of(candidates, quadratic(candidates))
    assert torch.equal(choice.q, quadratic(candidates).amax(1))
    assert torch.equal(quadratic(choice.action.unsqueeze(1)).squeeze(1), choice.q)


def test_the_search_stays_in_the_box_it_is_given_and_starts_where_it_says() -> None:
    seen: list[Tensor] = []
    low, high = torch.tensor([[-3.0, -1, -5, 0], [2, 2, 2, 2]]), torch.tensor([[3.0, 1, -4, 0], [2.5, 4, 4, 4]])
    space = SearchSpace(mean=(low + high) / 2, deviation=torch.tensor([[9.0], [0.01]]), low=low, high=high)

    def remembered(action: Tensor) -> Tensor:
        seen.append(action)
        return -(action - 2.2).square().sum(-1)

    choice = cross_entropy_method(remembered, cem_noise(seeded("tests/cem"), batch=2, iterations=4), space=space)
    for action in [*seen, choice.action.unsqueeze(1)]:
        assert bool(((action >= low.unsqueeze(1)) & (action <= high.unsqueeze(1))).all())
    assert float(seen[0][1, :, 1:].std(0).amax()) < 0.02
    torch.testing.assert_close(seen[0][1].mean(0), torch.tensor([2.25, 3, 3, 3]), rtol=0, atol=0.01)
    torch.testing.assert_close(choice.action[0], torch.tensor([2.2, 1, -4, 0]), rtol=0, atol=0.2)


@pytest.mark.parametrize("elites", [1, 65])
def test_an_impossible_number_of_elites_is_refused(elites: int) -> None:
    with pytest.raises(ValueError, match="2 to 64 elites"):
        cross_entropy_method(quadratic, cem_noise(seeded("tests/cem"), batch=2), SPACE, elites=elites)
