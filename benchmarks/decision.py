"""Milliseconds of a policy's decision: CEM with the trunk once, against the usual ways, and against an actor network.

    python benchmarks/decision.py

Dimension key: B states, N candidates, A action.
"""

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor, nn

from graspq.benchmarks.measuring import (
    Ratio,
    Result,
    Row,
    TurnsSettings,
    command,
    greatest_difference,
    median_ratio,
    take_turns,
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
STEPS = 15
ACTION = grasping((0.06, 0.06, 0.06, 0.5))
CANDIDATES = (1, 16, 192)
ACTOR = "actor network"


@dataclass(frozen=True)
class DecisionSettings(TurnsSettings):
    """Settings of this benchmark."""

    turns: int = setting(7, help="Turns that are measured, after one that is not.", minimum=1)
    network: str = setting("default", help="Network: default or paper.")
    batch: tuple[int, ...] = setting((1, 32), help="States that are decided for at once.")
    many: tuple[int, ...] = setting((1, 256), help="States for which Q of candidates is asked at once.")
    threads: int | None = setting(None, help="CPU threads; torch's own choice if not given.", minimum=1)


def states(batch: int) -> tuple[Tensor, Tensor]:
    """Return pictures, uint8 [B, 64, 64, 3], and steps, int64 [B]."""
    image = torch.randint(0, 256, (batch, 64, 64, 3), dtype=torch.uint8, generator=seeded("benchmarks/decision", batch))
    return image, torch.arange(batch) % STEPS


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


def check_deviation(network: QNetwork, batch: int) -> float:
    """Return the standard deviation of Q over 192 candidates, the least of all states.

    Raises:
        UserError: it is so small that rivals would agree whatever they computed.
    """
    deviation = float(network.at(*states(batch))(candidates(batch, max(CANDIDATES))).std(dim=1).min())
    if not deviation >= LEAST_DEVIATION:
        raise UserError(f"Q of candidates deviates by {deviation:.2g}: equal Q of rivals would prove nothing")
    return deviation


def search(way: Way, network: QNetwork, batch: int) -> Callable[[], Choice]:
    """Return what decides for some states, by the same noise whatever the way."""
    cem = CemSettings()
    image, step = states(batch)
    shape = (cem.iterations, batch, cem.samples, ACTION.size)
    noise = torch.randn(shape, generator=seeded("benchmarks/decision/noise", batch))
    return lambda: cross_entropy_method(way(network, image, step), noise, single_steps(ACTION, noise))


def check_rivals(network: QNetwork, batch: int) -> float:
    """Return how far the Q of rivals lies from ours, at most: of 64 candidates, and of what a search finds.

    What a search finds depends on the order of Q alone: without the candidates a shifted Q would look the same.

    Raises:
        UserError: a rival computes something else.
    """

    def q(way: Way) -> Tensor:
        asked = way(network, *states(batch))(candidates(batch, 64))
        return torch.cat([asked, search(way, network, batch)().q.unsqueeze(1)], dim=1)

    return greatest_difference(q(WAYS[ONCE]), {name: q(way) for name, way in WAYS.items()})


def decision_rows(network: QNetwork, actor: nn.Module, batch: int, turns: int) -> list[Row]:
    """Return a row for each way to decide."""
    image, step = states(batch)
    runs: dict[str, Callable[[], Any]] = {name: search(way, network, batch) for name, way in WAYS.items()}
    seconds = take_turns(runs | {ACTOR: lambda: pointed(actor(image, step), ACTION)}, turns)
    return [
        {
            "batch": batch,
            "decision": name,
            "ms a state": 1e3 * statistics.median(values) / batch,
            "times of trunk once": median_ratio(values, seconds[ONCE]),
        }
        for name, values in seconds.items()
    ]


def candidate_rows(network: QNetwork, batch: int, turns: int) -> list[Row]:
    """Return what Q of 1, 16 and 192 candidates costs, trunk included.

    Raises:
        UserError: a candidate's Q depends on the others.
    """
    image, step = states(batch)
    given = {str(count): candidates(batch, count) for count in CANDIDATES}
    first = {count: network.at(image, step)(actions)[:, :1] for count, actions in given.items()}
    greatest_difference(first["1"], {f"Q of {count} candidates": q for count, q in first.items()})
    calls = range(max(1, 64 // batch))  # one call for one state takes a millisecond: too short to time

    def judge(actions: Tensor) -> Callable[[], Any]:
        return lambda: [network.at(image, step)(actions) for _ in calls]

    seconds = take_turns({count: judge(actions) for count, actions in given.items()}, turns)
    return [
        {
            "batch": batch,
            "candidates": count,
            "ms a state": 1e3 * statistics.median(values) / (batch * len(calls)),
            "times of 1 candidate": median_ratio(values, seconds["1"]),
        }
        for count, values in seconds.items()
    ]


@torch.inference_mode()
def measure(settings: DecisionSettings) -> Result:
    """Return milliseconds of decisions and of Q of candidates, after a check that rivals agree."""
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    specification = NetworkSpecification(settings.network, (64, 64, 3), ACTION, STEPS, "logistic")
    network = cast(QNetwork, build(q_network, specification, seeded("benchmarks/decision/weights"))).eval()
    actor = build(state_network(ACTION.size), specification, seeded("benchmarks/decision/weights")).eval()
    spread_out(network)
    deviation = min(check_deviation(network, batch) for batch in {*settings.batch, *settings.many})
    difference = max(check_rivals(network, batch) for batch in settings.batch)
    rows = [row for batch in settings.batch for row in decision_rows(network, actor, batch, settings.turns)]
    costs = [row for batch in settings.many for row in candidate_rows(network, batch, settings.turns)]
    tiled = next(row["times of trunk once"] for row in rows if row["decision"] == TILED)
    return Result(
        [Ratio("a CEM decision, against 64 tiled copies in each iteration", tiled, bar=4)],
        {"Decisions of a policy": rows, "Q of N candidates for a state, trunk once": costs},
        {
            "threads": torch.get_num_threads(),
            "greatest difference of Q": difference,
            "standard deviation of Q over candidates, least of all states": deviation,
        },
    )


main = command(DecisionSettings, measure)


if __name__ == "__main__":
    main()
