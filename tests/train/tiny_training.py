"""Training of an estimator's row on the tiny decision process, by its own update, with networks of few weights.

Dimensions: B batch, T = 3 steps, X = 3 places, A = 4 action, G × G grid of actions.
"""

import contextlib
from collections.abc import Iterator

import numpy as np
import torch
from tiny_mdp import AXIS, DISCOUNT, PLACES, SIZE, STEPS, Data, Floats, pictures
from torch import Tensor, nn

from graspq.train import networks
from graspq.train.estimators import Estimator
from graspq.train.networks import Features, NetworkSpecification, QNetwork, StateNetwork
from graspq.train.settings import TrainSettings
from graspq.train.state import Context, TrainState, advance, learning_rate, new_state, seeded
from graspq.train.updates import LINKS

WIDTH = 48
COARSE = slice(None, None, 10)


def _state_of(image: Tensor, step: Tensor) -> Tensor:
    # One pixel of each bar is all that tells the places apart.
    bars = image[:, 2::5, 0, 0].float() / 64 - 2
    return torch.cat([bars, nn.functional.one_hot(step, STEPS).float()], 1)


class TinyNetwork(QNetwork):
    """Two hidden layers over the place's picture, the step and the action."""

    def __init__(self, specification: NetworkSpecification) -> None:
        super().__init__()
        self.state = nn.Linear(PLACES + STEPS, WIDTH)
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
        self.hidden = nn.Linear(PLACES + STEPS, WIDTH)
        self.last = nn.Linear(WIDTH, outputs)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, image: Tensor, step: Tensor) -> Tensor:
        output: Tensor = self.last(self.hidden(_state_of(image, step)).relu())
        return output


@contextlib.contextmanager
def tiny_networks() -> Iterator[None]:
    """Enter the tiny networks into the table of networks for a while."""
    networks.NETWORKS["tiny"] = lambda: networks._Family(TinyNetwork, TinyStateNetwork)
    try:
        yield
    finally:
        del networks.NETWORKS["tiny"]


def fit(row: Estimator, data: Data, settings: TrainSettings) -> TrainState:
    """Train an estimator by its own update; batches are drawn with replacement.

    Args:
        row: the estimator.
        data: what it learns from.
        settings: steps, batch size (transitions), learning rate, loss and so on.
    """
    specification = NetworkSpecification("tiny", (SIZE, SIZE, 3), 4, STEPS, LINKS[settings.loss])
    state = new_state(specification, settings, torch.device("cpu"), row.parts)
    state.extra = row.extra(data)  # type: ignore[arg-type]
    while state.step < settings.steps:
        generator = seeded("tests/tiny", settings.seed, state.step)
        if row.view == "episodes":
            size = settings.batch_size * data.episodes // data.rows
            batch = data.whole_episodes(torch.randint(data.episodes, (size,), generator=generator))
        else:
            batch = data.transitions(torch.randint(data.rows, (settings.batch_size,), generator=generator))
        for optimizer in state.optimizers.values():
            for group in optimizer.param_groups:
                group["lr"] = learning_rate(settings, state.step)
        row.update(state, batch, row, context(state, settings, generator))
        advance(state, settings)
    return state


def context(state: TrainState, settings: TrainSettings, generator: torch.Generator) -> Context:
    """Return the context of one update."""
    return Context(
        networks=state.learned,
        lagged_networks=state.lagged,
        loss=settings.loss,
        discount=DISCOUNT if settings.discount is None else settings.discount,
        candidates=settings.candidates,
        generator=generator,
        progress=state.step / settings.steps,
        autocast=contextlib.nullcontext,
        anneal=settings.anneal,
        centred=settings.centred,
        mirror=settings.mirror,
        actor_rest=settings.actor_rest,
        actor_rate=settings.actor_rate,
        actor_every=settings.actor_every,
        path_steps=settings.path_steps,
        penalty=settings.penalty,
        kl_bound=settings.kl_bound,
        extra=state.extra,
    )


@torch.no_grad()
def q_on_grid(state: TrainState) -> Floats:
    """Return Q_θ of the network that acts, on every tenth point of the grid, [T, X, G, G]."""
    axis = torch.from_numpy(AXIS[COARSE]).float()
    action = torch.zeros(len(axis), len(axis), 4)
    action[..., 0], action[..., 2] = axis[:, None], axis[None, :]
    result = []
    network = state.acting["q"]
    assert isinstance(network, QNetwork)
    network.eval()
    for step in range(STEPS):
        q = network.at(pictures(), torch.full((PLACES,), step))
        result.append(q(action.flatten(0, 1).expand(PLACES, -1, -1)).unflatten(1, action.shape[:2]))
    return torch.stack(result).double().numpy()


def distance(state: TrainState, q: Floats) -> float:
    """Return max |Q_θ - Q| over steps, places and the coarse grid of actions."""
    return float(np.abs(q_on_grid(state) - q[:, :, COARSE, COARSE]).max())
