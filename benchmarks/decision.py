"""Milliseconds of a policy's decision: CEM with the trunk once, against the usual ways, and against an actor network.

    python benchmarks/decision.py

The rivals search with the same noise and must find the same Q (to 1e-4): the whole network on 64 tiled copies of the
image in every iteration, and the trunk anew in every iteration. Weights are fresh: time does not depend on them.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import torch
from rivals import anew, tiled
from timing import median_ratio, report, take_turns

from graspq.train.networks import NetworkSpecification, QNetwork, make_network, make_state_network
from graspq.train.selection import QOfActions, cem_noise, cross_entropy_method, pointed
from graspq.train.state import seeded

TOLERANCE = 1e-4


def decisions(network: QNetwork, actor: torch.nn.Module, batch: int) -> dict[str, Callable[[], Any]]:
    """Return the rivals, each of which decides for the same `batch` states; refuses rivals that disagree."""
    generator = seeded("benchmarks/decision")
    image = torch.randint(0, 256, (batch, 64, 64, 3), dtype=torch.uint8, generator=generator)
    step = torch.zeros(batch, dtype=torch.int64)
    noise = cem_noise(generator, batch)

    def search(make: Callable[[], QOfActions]) -> Callable[[], Any]:
        return lambda: cross_entropy_method(make(), noise)

    rivals = {
        "cem, trunk once": search(lambda: network.at(image, step)),
        "cem, trunk each iteration": search(lambda: anew(network, image, step)),
        "cem, 64 tiled copies": search(lambda: tiled(network, image, step)),
        "actor network": lambda: pointed(actor(image, step)),
    }
    q = [rivals[name]().q for name in list(rivals)[:3]]
    for name, other in zip(list(rivals)[1:3], q[1:], strict=True):
        difference = float((q[0] - other).abs().max())
        if difference > TOLERANCE:
            raise click.ClickException(f"{name}: Q differs by {difference:.2g}, expected at most {TOLERANCE}")
    return rivals


@click.command()
@click.option("--network", type=click.Choice(["default", "paper"]), default="default", show_default=True)
@click.option("--turns", type=click.IntRange(1), default=7, show_default=True, help="Turns that are measured.")
@click.option("--threads", type=click.IntRange(1), default=None, help="CPU threads; torch's own choice if not given.")
@click.option("--out", type=click.Path(path_type=Path), default=None, help="JSON file for the figures.")
@torch.inference_mode()
def main(network: str, turns: int, threads: int | None, out: Path | None) -> None:
    """Measure decisions for batches of 1 and 32 states."""
    if threads is not None:
        torch.set_num_threads(threads)
    specification = NetworkSpecification(network, (64, 64, 3), 4, 15, "logistic")
    q_network = make_network(specification, seeded("benchmarks/decision/weights")).eval()
    actor = make_state_network(specification, 4, seeded("benchmarks/decision/weights")).eval()
    rows = []
    for batch in (1, 32):
        seconds = take_turns(decisions(q_network, actor, batch), turns)
        ours = seconds["cem, trunk once"]
        rows += [
            {
                "batch": batch,
                "decision": name,
                "ms a state": 1e3 * sorted(values)[len(values) // 2] / batch,
                "times of trunk once": median_ratio(values, ours),
            }
            for name, values in seconds.items()
        ]
    facts = {"network": network, "threads": torch.get_num_threads(), "greatest difference of Q": f"< {TOLERANCE}"}
    report("Decisions of a policy (CEM: 3 iterations of 64 samples)", rows, facts, out)


if __name__ == "__main__":
    main()
