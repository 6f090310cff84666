"""Learning on a decision process whose values are known in closed form; see `conftest.py`.

With γ = 0.9: Q*(A, dx > 0) = 0.9, Q*(A, dx < 0) = 0.25, Q*(B, dx > 0) = 1, Q*(B, dx < 0) = 0. The behaviour's own value
is Q(A, dx > 0) = 0.5, undiscounted, and the same elsewhere.
"""

from collections.abc import Callable
from types import SimpleNamespace

import pytest
import torch

from graspq.train.checkpoint import load_policy_network
from graspq.train.loop import train
from graspq.train.selection import cem_noise, cross_entropy_method
from graspq.train.settings import TrainSettings
from graspq.train.state import seeded

EXPECTED = {"dql": [0.9, 0.25, 1.0, 0.0], "mc": [0.5, 0.25, 1.0, 0.0]}


@pytest.mark.parametrize("algo", ["dql", "mc"])
def test_the_estimator_reaches_its_own_values_and_cem_acts_on_them(
    settings: Callable[..., TrainSettings], two_states: SimpleNamespace, algo: str
) -> None:
    chosen = settings(
        algo,
        network="default",
        steps=200,
        batch_size=64,
        lag_steps=20,
        average_decay=0.95,
        warmup=0.05,
        validate_every=200,
    )
    run = train(chosen)
    network, _ = load_policy_network(run.folder)
    image = torch.stack(
        [torch.full((two_states.size, two_states.size, 3), two_states.grey[state], dtype=torch.uint8) for state in "AB"]
    )
    generator = seeded("tests/learning")
    actions = torch.rand(2, 400, 4, generator=generator) * 2 - 1
    with torch.no_grad():
        q = network.at(image, torch.tensor([0, 1]))
        values = q(actions)
        far = [
            (values[i][side & (actions[i, :, 0].abs() > 0.3)]).mean() for i in range(2) for side in sides(actions[i])
        ]
        choice = cross_entropy_method(q, cem_noise(generator, 2))
    torch.testing.assert_close(torch.stack(far), torch.tensor(EXPECTED[algo]), rtol=0, atol=0.12)
    assert bool((choice.action[:, 0] > 0).all())
    measures = [row["validation"] for row in run.metrics() if "validation" in row][-1]
    assert measures["calibration_error"] < 0.15 and measures["roc_auc_last_step"] > 0.8


def sides(action: torch.Tensor) -> list[torch.Tensor]:
    return [action[:, 0] > 0, action[:, 0] < 0]
