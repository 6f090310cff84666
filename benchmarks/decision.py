"""Milliseconds of a policy's decision: CEM with the trunk once, against the usual ways, and against an actor network.

    python benchmarks/decision.py

The rivals search with the same noise and must give candidates, and what they find, the same Q (to 1e-4): the whole
network on 64 tiled copies of the image in every iteration, and the trunk anew in every iteration. A further table says
what the Q of N candidates costs.
Weights are fresh, for time does not depend on them, but scaled: as they are, they give all candidates nearly the same
Q, and rivals would agree whatever they computed. Dimension key: B states, N candidates, A action.
"""

import statistics
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import click
import torch
from rivals import anew, once, tiled
from timing import median_ratio, report, take_turns
from torch import Tensor, nn

from graspq.common.options import Command
from graspq.train.networks import NetworkSpecification, QNetwork, make_network, make_state_network
from graspq.train.selection import Choice, QOfActions, cem_noise, cross_entropy_method, pointed, uniform_actions
from graspq.train.state import seeded

TOLERANCE = 1e-4
LEAST_DEVIATION = 0.01
OURS = "cem, trunk once"
WAYS: dict[str, Callable[[QNetwork, Tensor, Tensor], QOfActions]] = {
    OURS: once,
    "cem, trunk each iteration": anew,
    "cem, 64 tiled copies": tiled,
}
STEPS = 15
CANDIDATES = (1, 16, 192)
# How many states at once: for decisions, and for Q of candidates.
BATCHES, LARGE_BATCHES = (1, 32), (1, 256)
# A call for one state takes a millisecond: one alone would measure the clock and the caches.
STATES_A_TURN = 64


def states(batch: int) -> tuple[Tensor, Tensor]:
    """Return pictures, uint8 [B, 64, 64, 3], and steps, int64 [B]."""
    image = torch.randint(0, 256, (batch, 64, 64, 3), dtype=torch.uint8, generator=seeded("benchmarks/decision", batch))
    return image, torch.arange(batch) % STEPS


@torch.no_grad()
def spread_out(network: QNetwork) -> None:
    """Change fresh weights so that Q depends on all that a rival could get wrong.

    What starts at zero, such as the step's weights, gets numbers; the last layer is scaled so that the raw outputs of
    192 candidates in 32 states have mean 0 and, within a state, standard deviation 1.
    """
    generator = seeded("benchmarks/decision/spread")
    for parameter in network.parameters():
        if not parameter.any():
            parameter.normal_(std=0.1, generator=generator)
    output = network.head(network.trunk(*states(32)), uniform_actions(generator, 32, max(CANDIDATES)))
    deviation, last = output.std(dim=1).mean(), network.last
    assert isinstance(last, nn.Linear)
    last.weight.div_(deviation)
    last.bias.sub_(output.mean()).div_(deviation)


def deviation_of_q(network: QNetwork, batch: int) -> float:
    """Return the standard deviation of Q over 192 candidates, the least of all states.

    Raises:
        ClickException: it is so small that rivals would agree whatever they computed.
    """
    actions = uniform_actions(seeded("benchmarks/decision/candidates", batch), batch, max(CANDIDATES))
    deviation = float(network.at(*states(batch))(actions).std(dim=1).min())
    if not deviation >= LEAST_DEVIATION:
        raise click.ClickException(
            f"the standard deviation of Q over candidates is {deviation:.2g}, expected at least {LEAST_DEVIATION}: "
            "equal Q would prove nothing"
        )
    return deviation


def greatest_difference(q: Mapping[str, Tensor]) -> float:
    """Return how far the Q of any rival lies from the first one's, at most.

    Raises:
        ClickException: a rival computes something else.
    """
    (_, expected), *others = q.items()
    differences = {name: float((found - expected).abs().max()) for name, found in others}
    for name, difference in differences.items():
        if not difference <= TOLERANCE:
            raise click.ClickException(f"{name}: Q differs by {difference:.2g}, expected at most {TOLERANCE}")
    return max(differences.values())


def searches(network: QNetwork, batch: int) -> dict[str, Callable[[], Choice]]:
    """Return the rivals that search, ours first, each of which decides for the same states by the same noise."""
    image, step = states(batch)
    noise = cem_noise(seeded("benchmarks/decision/noise", batch), batch)

    def search(way: Callable[[QNetwork, Tensor, Tensor], QOfActions]) -> Callable[[], Choice]:
        return lambda: cross_entropy_method(way(network, image, step), noise)

    return {name: search(way) for name, way in WAYS.items()}


def q_by_way(network: QNetwork, batch: int) -> dict[str, Tensor]:
    """Return Q of 64 candidates and of the action that a search finds, [B, 65], by each of `WAYS`.

    What a search finds depends on the order of Q alone: without the candidates a shifted Q would look the same.
    """
    actions = uniform_actions(seeded("benchmarks/decision/candidates", batch), batch, 64)
    asked = {name: way(network, *states(batch))(actions) for name, way in WAYS.items()}
    found = {name: decide().q.unsqueeze(1) for name, decide in searches(network, batch).items()}
    return {name: torch.cat([asked[name], found[name]], dim=1) for name in WAYS}


def decision_rows(network: QNetwork, actor: nn.Module, batch: int, turns: int) -> tuple[list[dict[str, Any]], float]:
    """Return a row for each way to decide, and how far Q differs between those that search, at most.

    Raises:
        ClickException: a rival computes something else.
    """
    difference = greatest_difference(q_by_way(network, batch))
    image, step = states(batch)
    seconds = take_turns({**searches(network, batch), "actor network": lambda: pointed(actor(image, step))}, turns)
    rows = [
        {
            "batch": batch,
            "decision": name,
            "ms a state": 1e3 * statistics.median(values) / batch,
            "times of trunk once": median_ratio(values, seconds[OURS]),
        }
        for name, values in seconds.items()
    ]
    return rows, difference


def candidate_rows(network: QNetwork, batch: int, turns: int) -> tuple[list[dict[str, Any]], float]:
    """Return what Q of 1, 16 and 192 candidates costs, and how far a candidate's Q depends on the others, at most.

    Raises:
        ClickException: it depends on them.
    """
    image, step = states(batch)
    drawn = uniform_actions(seeded("benchmarks/decision/candidates", batch), batch, max(CANDIDATES))
    actions = {count: drawn[:, :count].contiguous() for count in CANDIDATES}
    q = {count: network.at(image, step)(given) for count, given in actions.items()}
    least = min(CANDIDATES)
    difference = greatest_difference({f"{count} candidates": found[:, :least] for count, found in q.items()})
    calls = max(1, STATES_A_TURN // batch)

    def judge(given: Tensor) -> Callable[[], None]:
        def run() -> None:
            for _ in range(calls):
                network.at(image, step)(given)

        return run

    seconds = take_turns({str(count): judge(given) for count, given in actions.items()}, turns)
    rows = [
        {
            "batch": batch,
            "candidates": count,
            "ms a state": 1e3 * statistics.median(seconds[str(count)]) / (batch * calls),
            "times of 1 candidate": median_ratio(seconds[str(count)], seconds[str(least)]),
        }
        for count in CANDIDATES
    ]
    return rows, difference


@click.command(cls=Command)
@click.option("--network", type=click.Choice(["default", "paper"]), default="default", show_default=True)
@click.option("--turns", type=click.IntRange(1), default=7, show_default=True, help="Turns that are measured.")
@click.option("--threads", type=click.IntRange(1), default=None, help="CPU threads; torch's own choice if not given.")
@click.option("--out", type=click.Path(path_type=Path), default=None, help="JSON file for the figures.")
@torch.inference_mode()
def main(network: str, turns: int, threads: int | None, out: Path | None) -> None:
    """Measure decisions for batches of 1 and 32 states, and Q of candidates for batches of 1 and 256."""
    if threads is not None:
        torch.set_num_threads(threads)
    specification = NetworkSpecification(network, (64, 64, 3), 4, STEPS, "logistic")
    q_network = make_network(specification, seeded("benchmarks/decision/weights")).eval()
    actor = make_state_network(specification, 4, seeded("benchmarks/decision/weights")).eval()
    spread_out(q_network)
    deviation = min(deviation_of_q(q_network, batch) for batch in {*BATCHES, *LARGE_BATCHES})
    decisions = [decision_rows(q_network, actor, batch, turns) for batch in BATCHES]
    candidates = [candidate_rows(q_network, batch, turns) for batch in LARGE_BATCHES]
    facts = {
        "network": network,
        "weights": "fresh, scaled so that Q differs between candidates",
        "threads": torch.get_num_threads(),
        "turns": turns,
        "greatest difference of Q": max(difference for _, difference in decisions + candidates),
        "standard deviation of Q over candidates, least of all states": deviation,
        "Q of N candidates for a state, trunk once": [row for rows, _ in candidates for row in rows],
    }
    rows = [row for found, _ in decisions for row in found]
    report("Decisions of a policy (CEM: 3 iterations of 64 samples)", rows, facts, out)


if __name__ == "__main__":
    main()
