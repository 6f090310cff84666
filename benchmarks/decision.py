"""Milliseconds of a policy's decision: CEM with the trunk once, against the usual ways, and against an actor network.

    python benchmarks/decision.py

Dimension key: B states, N candidates, A action.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import torch
from torch import Tensor, nn

from graspq.benchmarks.harness import (
    Ratio,
    Result,
    Row,
    TurnsSettings,
    check_equal,
    command,
    compared,
    median_ratio,
    take_turns,
    timed,
)
from graspq.benchmarks.rivals import ONCE, TILED, WAYS, Way
from graspq.common.action_space import grasping
from graspq.common.errors import UserError
from graspq.common.options import setting
from graspq.train.networks import build, q_network, state_network
from graspq.train.networks.network import NetworkSpecification, QNetwork
from graspq.train.search_settings import CemSettings
from graspq.train.selection import Choice, cross_entropy_method, pointed, single_steps, uniform_actions
from graspq.train.state import seeded

LEAST_DEVIATION = 0.01
ACTION = grasping((0.06, 0.06, 0.06, 0.5))
SPECIFICATION = NetworkSpecification("default", (64, 64, 3), ACTION, 15, "logistic")
CANDIDATES = (1, 16, 192)
ACTOR = "actor network"


@dataclass(frozen=True)
class DecisionSettings(TurnsSettings):
    """Settings of this benchmark."""

    turns: int = setting(7, help="Turns that are measured.", minimum=1)
    many: tuple[int, ...] = setting((1, 256), help="States for which Q of candidates is asked at once.")


def states(batch: int) -> tuple[Tensor, Tensor]:
    """Return pictures, uint8 [B, 64, 64, 3], and steps, int64 [B]."""
    image = torch.randint(0, 256, (batch, 64, 64, 3), dtype=torch.uint8, generator=seeded("benchmarks/decision", batch))
    return image, torch.arange(batch) % SPECIFICATION.steps


def candidates(batch: int, count: int) -> Tensor:
    """Return candidate actions, [B, N, A]; fewer of them are the first of more."""
    drawn = uniform_actions(seeded("benchmarks/decision/candidates", batch), batch, max(CANDIDATES), ACTION.size)
    return drawn[:, :count].contiguous()


@torch.no_grad()
def spread_out(network: QNetwork) -> None:
    """Change fresh weights so that Q depends on all that a rival could get wrong.

    What starts at zero, such as the step's weights, gets numbers; the last layer is scaled so that the raw outputs of
    192 candidates in 32 states have mean 0 and, within a state, standard deviation 1.
    """
    for parameter in network.parameters():
        if not parameter.any():
            parameter.normal_(std=0.1, generator=seeded("benchmarks/decision/spread"))
    output = network.head(network.trunk(*states(32)), candidates(32, max(CANDIDATES)))
    last = cast(nn.Linear, network.last)
    last.weight.div_(output.std(dim=1).mean())
    last.bias.sub_(output.mean()).div_(output.std(dim=1).mean())


def search(way: Way, network: QNetwork, batch: int) -> Callable[[], Choice]:
    """Return what decides for some states, by the same noise whatever the way."""
    cem, (image, step) = CemSettings(), states(batch)
    shape = (cem.iterations, batch, cem.samples, ACTION.size)
    noise = torch.randn(shape, generator=seeded("benchmarks/decision/noise", batch))
    return lambda: cross_entropy_method(way(network, image, step), noise, single_steps(ACTION, noise))


def check_rivals(network: QNetwork, batch: int) -> None:
    """Refuse rivals whose Q is another, of 64 candidates or of what a search finds (`UserError`).

    What a search finds depends on the order of Q alone: without the candidates a shifted Q would look the same. Nor
    may all candidates have nearly the same Q: then rivals would agree whatever they computed.
    """

    def q(way: Way) -> Tensor:
        asked = way(network, *states(batch))(candidates(batch, 64))
        return torch.cat([asked, search(way, network, batch)().q.unsqueeze(1)], dim=1)

    deviation = float(q(WAYS[ONCE])[:, :64].std(dim=1).min())
    if not deviation >= LEAST_DEVIATION:
        raise UserError(f"Q of candidates deviates by {deviation:.2g}: equal Q of rivals would prove nothing")
    check_equal(q(WAYS[ONCE]), {name: q(way) for name, way in WAYS.items()})


def candidate_rows(network: QNetwork, batch: int, turns: int) -> list[Row]:
    """Return what Q of 1, 16 and 192 candidates costs for a state; `UserError` where one's Q depends on the others."""
    image, step = states(batch)
    given = {str(count): candidates(batch, count) for count in CANDIDATES}
    first = {f"Q of {count} candidates": network.at(image, step)(actions)[:, :1] for count, actions in given.items()}
    check_equal(first["Q of 1 candidates"], first)
    calls = max(1, 64 // batch)  # one call for one state takes a millisecond: too short to time

    def judge(actions: Tensor) -> None:
        for _ in range(calls):
            network.at(image, step)(actions)

    judges = {count: timed(partial(judge, actions), batch * calls) for count, actions in given.items()}
    return [{"batch": batch, **row} for row in compared("candidates", "state", take_turns(judges, turns), "1")]


@torch.inference_mode()
def measure(settings: DecisionSettings) -> Result:
    """Return the time of decisions and of Q of candidates."""
    network = cast(QNetwork, build(q_network, SPECIFICATION, seeded("benchmarks/decision/weights"))).eval()
    actor = build(state_network(ACTION.size), SPECIFICATION, seeded("benchmarks/decision/weights")).eval()
    spread_out(network)
    check_rivals(network, 1)
    decide: dict[str, Callable[[], Any]] = {name: search(way, network, 1) for name, way in WAYS.items()}
    image, step = states(1)
    decide[ACTOR] = lambda: pointed(actor(image, step), ACTION)
    seconds = take_turns({name: timed(run) for name, run in decide.items()}, settings.turns)
    rows = compared("decision", "state", seconds, TILED)
    costs = [row for batch in settings.many for row in candidate_rows(network, batch, settings.turns)]
    faster = median_ratio(seconds[TILED], seconds[ONCE])
    return Result(
        [Ratio("a CEM decision, against 64 tiled copies in each iteration", faster, bar=4)],
        {"Decisions of a policy": rows, "Q of N candidates for a state, trunk once": costs},
        {"threads": torch.get_num_threads()},
    )


main = command(DecisionSettings, measure)


if __name__ == "__main__":
    main()
