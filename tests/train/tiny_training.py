"""Training of an estimator's row on the tiny decision process, by its own update, with networks of few weights.

Dimensions: B batch, T = 15 steps, X = 3 places, A = 4 action, G × G grid of actions.
"""

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from tiny_mdp import AXIS, PLACES, SIZE, STEPS, Data, Floats, pictures
from torch import Tensor, nn

from graspq.common.action_space import grasping
from graspq.train.device import Precision
from graspq.train.estimator import Estimator
from graspq.train.estimators import estimator_named
from graspq.train.networks import NETWORKS
from graspq.train.networks.network import Features, NetworkFamily, NetworkSpecification, QNetwork, StateNetwork
from graspq.train.settings import Preset, TrainSettings, complete
from graspq.train.state import TrainState, advance, learning_rate, new_state, seeded

WIDTH = 48
COARSE = slice(None, None, 10)


def _state_of(image: Tensor, step: Tensor) -> Tensor:
    # One pixel of each bar is all that tells the places apart.
    bars = image[:, 2::5, 0, 0].float() / 64 - 2
    steps = nn.functional.one_hot(step, STEPS).float()
    return torch.cat([bars, step.unsqueeze(1) / STEPS, steps], 1)


class TinyNetwork(QNetwork):
    """Two hidden layers over the place's picture, the step and the action."""

    def __init__(self, specification: NetworkSpecification) -> None:
        super().__init__()
        self.link = specification.link
        self.state = nn.Linear(PLACES + 1 + STEPS, WIDTH)
        self.state_and_step = nn.Linear(WIDTH, WIDTH)
        self.action = nn.Linear(4, WIDTH, bias=False)
        self.hidden = nn.Linear(WIDTH, WIDTH)
        self.last = nn.Linear(WIDTH, 1)

    def trunk(self, image: Tensor, step: Tensor) -> Features:
        return (self.state_and_step(self.state(_state_of(image, step)).relu()),)

    def head(self, features: Features, action: Tensor) -> Tensor:
        hidden = (features[0].unsqueeze(1) + self.action(action)).relu()
        output: Tensor = self.last(self.hidden(hidden).relu()).squeeze(-1)
        return output


class TinyStateNetwork(StateNetwork):
    """The same without the action; 0 at first, so that actors start alike in mirrored places."""

    def __init__(self, specification: NetworkSpecification, outputs: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(PLACES + 1 + STEPS, WIDTH)
        self.last = nn.Linear(WIDTH, outputs)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, image: Tensor, step: Tensor) -> Tensor:
        output: Tensor = self.last(self.hidden(_state_of(image, step)).relu())
        return output


@contextlib.contextmanager
def tiny_networks() -> Iterator[None]:
    """Enter the tiny networks into the table of networks for a while."""
    NETWORKS["tiny"] = NetworkFamily(TinyNetwork, TinyStateNetwork)
    try:
        yield
    finally:
        del NETWORKS["tiny"]


def tiny_settings(preset: Preset = "default", **given: Any) -> TrainSettings:
    """Return settings with the tiny networks; options that the estimator does not have are left out."""
    own = {field.name for field in dataclasses.fields(estimator_named(given["algo"]).settings)}
    common = {field.name for field in dataclasses.fields(TrainSettings)}
    known = {name: value for name, value in given.items() if name in own | common}
    return complete({"shards": ("none",), "network": "tiny", "precision": "float32"} | known, preset)


def fit(row: Estimator[Any], data: Data, settings: TrainSettings) -> TrainState:
    """Train an estimator by its own update; batches are drawn with replacement.

    Args:
        row: the estimator.
        data: what it learns from.
        settings: steps, batch size (transitions), learning rate, loss and so on.
    """
    action = grasping((0.06, 0.06, 0.06, 0.4))
    specification = NetworkSpecification("tiny", (SIZE, SIZE, 3), action, STEPS, row.loss(settings.own).link)
    precision, lag = Precision("float32", torch.device("cpu")), settings.own.lag
    state = new_state(
        specification, row.parts_of(settings.own), settings, settings.seed, precision, lagged=lag is not None
    )
    state.networks.kept.update(row.kept(data, settings.own))  # type: ignore[arg-type]
    while state.step < settings.steps:
        generator = seeded("tests/tiny", settings.seed, state.step)
        if row.target_value.view == "episodes":
            of_episodes = settings.own.counts_episodes
            size = settings.batch_size if of_episodes else settings.batch_size * data.episodes // data.rows
            batch = data.whole_episodes(torch.randint(data.episodes, (size,), generator=generator))
        else:
            batch = data.transitions(torch.randint(data.rows, (settings.batch_size,), generator=generator))
        for part in state.optimizers:
            state.set_rate(part, learning_rate(settings, state.step))
        row.update(row, state, batch, settings.own, generator, state.step / settings.steps)
        advance(state, settings.average_decay, lag)
    return state


@torch.no_grad()
def q_on_grid(state: TrainState) -> Floats:
    """Return Q_θ of the network that acts, on every tenth point of the grid, [T, X, G, G]."""
    axis = torch.from_numpy(AXIS[COARSE]).float()
    action = torch.zeros(len(axis), len(axis), 4)
    action[..., 0], action[..., 2] = axis[:, None], axis[None, :]
    result = []
    for step in range(STEPS):
        q = state.acting.q.eval().at(pictures(), torch.full((PLACES,), step))
        result.append(q(action.flatten(0, 1).expand(PLACES, -1, -1)).unflatten(1, action.shape[:2]))
    return torch.stack(result).double().numpy()


def distance(first: TrainState | Floats, second: Floats) -> float:
    """Return the largest over places and the first 8 steps of the mean over the coarse grid of actions of |Q_θ - Q|.

    From there the end is at least 7 steps away; what is learned of the last steps, where Q falls, comes later.
    """
    here = first[:, :, COARSE, COARSE] if isinstance(first, np.ndarray) else q_on_grid(first)
    return float(np.abs(here - second[:, :, COARSE, COARSE])[:8].mean((2, 3)).max())
