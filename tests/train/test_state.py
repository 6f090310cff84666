"""The training state: learning rates, the averaged and the lagged networks, and which weights decay."""

from collections.abc import Callable

import pytest
import torch
from plain import FLOAT32, specification

from graspq.train.networks import q_network, state_network
from graspq.train.settings import TrainSettings
from graspq.train.state import TrainState, advance, learning_rate, new_state

PARTS = {"q": q_network, "actor": state_network(lambda specification: specification.actions)}


@pytest.fixture
def make(settings: Callable[..., TrainSettings]) -> Callable[..., tuple[TrainState, TrainSettings]]:
    def made(**given: object) -> tuple[TrainState, TrainSettings]:
        chosen = settings("dql", **given)
        return new_state(specification(), PARTS, chosen, 0, FLOAT32, lagged=True), chosen

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
            state.networks.online[part].last.bias.data.fill_(float(factor * step))
        advance(state, chosen.average_decay, chosen.own.lag_steps)
        history.append(
            (state.networks.lagged["q"].last.bias[0].item(), state.networks.lagged["actor"].last.bias[0].item())
        )
    assert history[2:] == [(3.0, 6.0), (3.0, 6.0), (3.0, 6.0), (6.0, 12.0), (6.0, 12.0)]


def test_the_lagged_network_takes_running_statistics_over(make: Callable[..., object]) -> None:
    state, chosen = make(lag_steps=1)  # type: ignore[misc]
    state.networks.online["q"].encoder.stem[1].running_mean.fill_(7.0)
    advance(state, chosen.average_decay, chosen.own.lag_steps)
    assert torch.equal(state.networks.lagged["q"].encoder.stem[1].running_mean, torch.full((16,), 7.0))


def test_the_averaged_network_follows_its_recursion(make: Callable[..., object]) -> None:
    state, chosen = make(average_decay=0.5)  # type: ignore[misc]
    mean = state.averaged["q"].last.bias.item()
    for step in range(1, 30):
        state.networks.online["q"].last.bias.data.fill_(float(step))
        advance(state, chosen.average_decay, chosen.own.lag_steps)
        decay = min(0.5, (1 + step) / (10 + step))
        mean = decay * mean + (1 - decay) * step
        assert state.averaged["q"].last.bias.item() == pytest.approx(mean, rel=1e-5)


def test_policies_use_the_averaged_networks_where_there_are_any(make: Callable[..., object]) -> None:
    state, _ = make(average_decay=0.9)  # type: ignore[misc]
    assert state.acting.online is state.averaged and list(state.acting.online) == ["q", "actor"]
    state, _ = make(average_decay=0.0)  # type: ignore[misc]
    assert state.acting.online is state.networks.online and not state.averaged


def test_every_network_has_its_own_name_in_a_checkpoint(make: Callable[..., object]) -> None:
    state, _ = make(average_decay=0.9)  # type: ignore[misc]
    names = ["q", "actor", "lagged-q", "lagged-actor", "averaged-q", "averaged-actor"]
    assert list(state.named_networks) == names
    assert len({id(network) for network in state.named_networks.values()}) == len(names)


def test_only_matrices_and_filters_decay(make: Callable[..., object]) -> None:
    state, _ = make(weight_decay=0.1)  # type: ignore[misc]
    for optimizer in state.optimizers.values():
        decaying, others = optimizer.param_groups
        assert decaying["weight_decay"] == 0.1 and others["weight_decay"] == 0.0
        assert {parameter.dim() for parameter in others["params"]} == {1}
        assert min(parameter.dim() for parameter in decaying["params"]) == 2


def test_without_lagged_networks_there_are_none(settings: Callable[..., TrainSettings]) -> None:
    state = new_state(specification(), PARTS, settings("mc"), 0, FLOAT32, lagged=False)
    assert not state.networks.lagged
    advance(state, 0.9, None)
    assert state.step == 1


def test_a_rate_holds_for_the_next_step_alone_and_is_slowed_down_by_factors(make: Callable[..., object]) -> None:
    state, _ = make()  # type: ignore[misc]
    for _ in range(2):
        state.set_rate("actor", 0.1)
        state.slow_down("actor", 0.5)
        state.slow_down("actor", 0.5)
        assert {group["lr"] for group in state.optimizers["actor"].param_groups} == {0.025}
