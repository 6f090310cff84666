"""The training state: learning rates, the averaged and the lagged networks, and which weights decay."""

from collections.abc import Callable

import pytest
import torch

from graspq.train.networks import NetworkSpecification
from graspq.train.settings import TrainSettings
from graspq.train.state import TrainState, advance, learning_rate, new_state

SPECIFICATION = NetworkSpecification("default", (16, 16, 3), 4, 15, "logistic")


@pytest.fixture
def make(settings: Callable[..., TrainSettings]) -> Callable[..., tuple[TrainState, TrainSettings]]:
    def made(**given: object) -> tuple[TrainState, TrainSettings]:
        chosen = settings(**given)
        return new_state(SPECIFICATION, chosen, torch.device("cpu"), {"q": 1, "actor": 4}), chosen

    return made


def test_the_cosine_schedule_rises_linearly_and_falls_to_nothing(settings: Callable[..., TrainSettings]) -> None:
    chosen = settings(steps=100, learning_rate=1.0, warmup=0.1, schedule="cosine")
    rates = [learning_rate(chosen, step) for step in range(100)]
    assert rates[:4] == pytest.approx([0.1, 0.2, 0.3, 0.4])
    assert max(rates) == 1.0 and rates[9] == rates[10] == 1.0
    assert rates[55] == pytest.approx(0.5)
    assert rates[10:] == sorted(rates[10:], reverse=True) and 0 < rates[-1] < 0.001


def test_the_constant_schedule_is_constant(settings: Callable[..., TrainSettings]) -> None:
    chosen = settings(steps=50, learning_rate=0.003, warmup=0.0, schedule="constant")
    assert {learning_rate(chosen, step) for step in range(50)} == {0.003}


def test_the_lagged_network_is_a_copy_of_the_last_multiple_of_lag_steps(make: Callable[..., object]) -> None:
    state, chosen = make(lag_steps=3)  # type: ignore[misc]
    history = []
    for step in range(1, 8):
        for factor, part in enumerate(("q", "actor"), start=1):
            state.learned[part].last.bias.data.fill_(float(factor * step))
        advance(state, chosen)
        history.append((state.lagged["q"].last.bias[0].item(), state.lagged["actor"].last.bias[0].item()))
    assert history[2:] == [(3.0, 6.0), (3.0, 6.0), (3.0, 6.0), (6.0, 12.0), (6.0, 12.0)]


def test_the_lagged_network_takes_running_statistics_over(make: Callable[..., object]) -> None:
    state, chosen = make(lag_steps=1)  # type: ignore[misc]
    state.learned["q"].encoder.stem[1].running_mean.fill_(7.0)
    advance(state, chosen)
    assert torch.equal(state.lagged["q"].encoder.stem[1].running_mean, torch.full((16,), 7.0))


def test_the_averaged_network_follows_its_recursion(make: Callable[..., object]) -> None:
    state, chosen = make(average_decay=0.5)  # type: ignore[misc]
    mean = state.averaged["q"].last.bias.item()
    for step in range(1, 30):
        state.learned["q"].last.bias.data.fill_(float(step))
        advance(state, chosen)
        decay = min(0.5, (1 + step) / (10 + step))
        mean = decay * mean + (1 - decay) * step
        assert state.averaged["q"].last.bias.item() == pytest.approx(mean, rel=1e-5)


def test_policies_use_the_averaged_networks_where_there_are_any(make: Callable[..., object]) -> None:
    state, _ = make(average_decay=0.9)  # type: ignore[misc]
    assert state.acting is state.averaged and list(state.acting) == ["q", "actor"]
    state, _ = make(average_decay=0.0)  # type: ignore[misc]
    assert state.acting is state.learned and not state.averaged


def test_every_network_has_its_own_name_in_a_checkpoint(make: Callable[..., object]) -> None:
    state, _ = make(average_decay=0.9)  # type: ignore[misc]
    names = ["q", "actor", "lagged-q", "lagged-actor", "averaged-q", "averaged-actor"]
    assert list(state.networks) == names
    assert len({id(network) for network in state.networks.values()}) == len(names)


def test_only_matrices_and_filters_decay(make: Callable[..., object]) -> None:
    state, _ = make(weight_decay=0.1)  # type: ignore[misc]
    for optimizer in state.optimizers.values():
        decaying, others = optimizer.param_groups
        assert decaying["weight_decay"] == 0.1 and others["weight_decay"] == 0.0
        assert {parameter.dim() for parameter in others["params"]} == {1}
        assert min(parameter.dim() for parameter in decaying["params"]) == 2
