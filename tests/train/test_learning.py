"""Every estimator learns what it ought to on a stochastic decision process that is solved exactly; see `tiny_mdp.py`.

Off-policy data, continuous actions, discount 0.9, cross-entropy. Distances are max |Q_θ - Q| over steps, places and a
grid of 21 × 21 actions. `pcl` learns on a mirrored process of two places and uniform actions: where what follows is
uncertain, the square of a residual is not least at the optimum (see `pcl`, Bias), and no tolerance would mean much.
"""

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tiny_mdp
import torch
from plain import ACTION
from tiny_training import distance, fit, tiny_networks, tiny_settings

from graspq.train.checkpoint import load_acting
from graspq.train.estimators import ESTIMATORS
from graspq.train.estimators.pcl import policy_of
from graspq.train.loop import train
from graspq.train.selection import cross_entropy_method, single_steps
from graspq.train.settings import TrainSettings
from graspq.train.state import TrainState, seeded

NEAR, GAP = 0.12, 0.25
Q_STAR = tiny_mdp.solve(tiny_mdp.largest)
Q_BEHAVIOUR = tiny_mdp.solve(tiny_mdp.behaviour_mean)


@pytest.fixture(autouse=True, scope="module")
def networks() -> Iterator[None]:
    with tiny_networks():
        yield


@pytest.fixture(scope="module")
def data() -> tiny_mdp.Data:
    return tiny_mdp.collect(60_000, seed=0)


def short(**given: Any) -> TrainSettings:
    values = {
        "steps": 800,
        "batch_size": 256,
        "learning_rate": 3e-3,
        "weight_decay": 0.0,
        "average_decay": 0.99,
        "lag_steps": 25,
        "anneal": 0.3,
        # 800 steps are few for an actor at a tenth of Q's rate.
        "actor_rate": 1.0,
    }
    return tiny_settings(**values | given)


def learned(algo: str, data: tiny_mdp.Data, **given: Any) -> TrainState:
    return fit(ESTIMATORS[algo], data, short(algo=algo, **given))


def test_the_exact_solutions_satisfy_their_equations_and_lie_apart() -> None:
    rng = np.random.default_rng(0)
    step, place = 0, 0
    far, near = tiny_mdp.largest(Q_STAR[1])[:2]
    for i, j in rng.integers(0, tiny_mdp.GRID, (20, 2)):
        dx, dz = tiny_mdp.AXIS[i], tiny_mdp.AXIS[j]
        close = 1 / (1 + np.exp(6 * dz + 2))
        approach = 0.1 + 0.8 / (1 + np.exp(-6 * dx))
        bellman = close * 0.05 + (1 - close) * 0.9 * (approach * near + (1 - approach) * far)
        assert Q_STAR[step, place, i, j] == pytest.approx(bellman, abs=1e-12)
    assert np.abs(Q_STAR - Q_BEHAVIOUR).max() == pytest.approx(0.316, abs=0.001)
    for wrong in (0.7, 1.0):
        assert np.abs(Q_STAR - tiny_mdp.solve(tiny_mdp.largest, wrong)).max() > 0.15


def test_the_observed_returns_have_the_mean_of_the_behaviours_exact_values(data: tiny_mdp.Data) -> None:
    for place in range(tiny_mdp.PLACES):
        returns = data.columns["mc_return"][data.place[:, 0] == place, 0]
        exact = tiny_mdp.behaviour_mean(Q_BEHAVIOUR[0])[place]
        assert float(returns.mean()) == pytest.approx(exact, abs=5 * float(returns.std()) / len(returns) ** 0.5)


@pytest.mark.parametrize("algo", ["dql", "corr-mc", "ddpg", "blend"])
def test_bootstrapped_and_corrected_estimators_reach_the_optimal_values(algo: str, data: tiny_mdp.Data) -> None:
    state = learned(algo, data)
    assert distance(state, Q_STAR) < NEAR
    assert distance(state, Q_BEHAVIOUR) > GAP
    for wrong in (0.7, 1.0):
        assert distance(state, tiny_mdp.solve(tiny_mdp.largest, wrong)) > distance(state, Q_STAR) + 0.03


def test_mc_reaches_the_behaviours_values_and_misses_the_optimal_ones(data: tiny_mdp.Data) -> None:
    state = learned("mc", data)
    assert distance(state, Q_BEHAVIOUR) < NEAR
    assert distance(state, Q_STAR) > GAP


def test_supervised_reaches_the_mean_outcome_given_the_displacement(data: tiny_mdp.Data) -> None:
    undiscounted = tiny_mdp.collect(60_000, seed=0, discount=1.0)
    state = learned("supervised", undiscounted)
    exact = tiny_mdp.supervised_mean()
    displacement = torch.arange(tiny_mdp.PLACES) - torch.arange(tiny_mdp.PLACES).unsqueeze(1)
    synthetic = torch.zeros(*displacement.shape, 4)
    synthetic[..., 0] = displacement / 2
    network: Any = state.acting.online["q"]
    with torch.no_grad():
        for step in range(tiny_mdp.STEPS):
            q = network.at(tiny_mdp.pictures(), torch.full((tiny_mdp.PLACES,), step))(synthetic).numpy()
            possible = np.isfinite(exact[step])
            assert np.abs(q - exact[step])[possible].max() < 0.06
    assert np.ptp(exact[0, 0]) > 0.5 and exact[1, 1, 2] - exact[1, 0, 1] > 0.4


def test_pcl_reaches_its_regularised_optimum_near_the_lagged_policy() -> None:
    penalty = 0.15
    data = tiny_mdp.collect_mirrored(60_000, seed=0)
    state = learned("pcl", data, lag_steps=10_000, penalty=penalty)
    picture, step = tiny_mdp.pictures()[[0, 1, 0, 1]], torch.tensor([0, 0, 1, 1])
    with torch.no_grad():
        lagged = policy_of(state.networks.lagged["actor"](picture, step), ACTION)
        policy = policy_of(state.acting.online["actor"](picture, step), ACTION)
        value = state.acting.online["v"](picture, step).view(2, 2)
    mean, deviation = (x[:, 0].view(2, 2).double().numpy() for x in (lagged.mean, lagged.log_deviation.exp()))
    best_value, best_mean = tiny_mdp.mirrored(mean, deviation, penalty)
    assert np.abs(value.numpy() - best_value).max() < 0.03
    assert np.abs(policy.mean[:, 0].view(2, 2).numpy() - best_mean).max() < 0.06
    assert np.abs(best_mean - mean).min() > 0.25
    unregularised = tiny_mdp.BASE[:, None] + tiny_mdp.SLOPE[:, None]
    assert np.abs(best_value - unregularised).max() > 0.1


def test_the_whole_loop_with_the_default_network_learns_from_shards_and_cem_acts_on_it(
    settings: Callable[..., TrainSettings], two_states: SimpleNamespace
) -> None:
    # The process of `conftest.py`; Q* at dx > 0 and dx < 0, in state A and in state B.
    expected = torch.tensor([0.9, 0.25, 1.0, 0.0])
    run = train(settings("dql", steps=200, batch_size=64, lag_steps=20, average_decay=0.95, save_every=200))
    network: Any = load_acting(run.folder).networks["q"]
    shape = (two_states.size, two_states.size, 3)
    image = torch.stack([torch.full(shape, two_states.grey[state], dtype=torch.uint8) for state in "AB"])
    generator = seeded("tests/learning")
    actions = torch.rand(2, 400, 4, generator=generator) * 2 - 1
    with torch.no_grad():
        q = network.at(image, torch.tensor([0, 1]))
        values, dx = q(actions), actions[..., 0]
        means = [values[i][side[i]].mean() for i in range(2) for side in (dx > 0.3, dx < -0.3)]
        noise = torch.randn(3, 2, 64, 4, generator=generator)
        choice = cross_entropy_method(q, noise, single_steps(ACTION, noise))
    torch.testing.assert_close(torch.stack(means), expected, rtol=0, atol=0.12)
    assert bool((choice.action[:, 0] > 0).all())
    measures = [row["validation"] for row in run.metrics() if "validation" in row][-1]
    assert measures["calibration_error"] < 0.15 and measures["roc_auc_last_step"] > 0.8
    assert 0.15 < measures["soft_opc"] < 0.35 and 0.2 < measures["opc"] < 0.42, (measures["opc"], measures["soft_opc"])
