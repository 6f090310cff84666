"""The table of estimators, and the double-Q target on Q-functions whose values are known."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from plain_context import plain_context
from torch import Tensor

from graspq.common.errors import UserError
from graspq.train.batch import Batch
from graspq.train.estimators import ESTIMATORS, as_markdown, estimator_named
from graspq.train.loop import train
from graspq.train.networks import Features, QNetwork
from graspq.train.selection import uniform_actions
from graspq.train.settings import TrainSettings
from graspq.train.state import Context, seeded
from graspq.train.updates import cross_entropy, squared


class Slope(QNetwork):
    """Q(s, a) = slope · dx + step."""

    link = "identity"

    def __init__(self, slope: float) -> None:
        super().__init__()
        self.slope, self.trunks = slope, 0

    def trunk(self, image: Tensor, step: Tensor) -> Features:
        self.trunks += 1
        return (step.float(),)

    def head(self, features: Features, action: Tensor) -> Tensor:
        return self.slope * action[..., 0] + features[0].unsqueeze(1)


def context(network: QNetwork, lagged: QNetwork) -> Context:
    return plain_context({"q": network}, {"q": lagged})


def batch() -> Batch:
    image = torch.zeros(2, 1, 8, 8, 3, dtype=torch.uint8)
    return Batch(
        image=image,
        step=torch.tensor([[0], [3]]),
        action=torch.zeros(2, 1, 4),
        reward=torch.tensor([[0.0], [1.0]]),
        terminal=torch.tensor([[False], [True]]),
        mc_return=torch.tensor([[0.25], [1.0]]),
        synthetic_action=torch.zeros(2, 1, 4),
        next_image=image,
        next_step=torch.tensor([[1], [4]]),
    )


def test_the_double_q_target_lets_the_network_pick_and_the_lagged_one_judge() -> None:
    network, lagged = Slope(1.0), Slope(-2.0)
    target = ESTIMATORS["dql"].target(batch(), context(network, lagged))
    drawn = uniform_actions(seeded("tests/draws"), batch=2, candidates=16)
    largest_dx = drawn[0, :, 0].max()
    expected = torch.stack([0.9 * (-2.0 * largest_dx + 1), torch.tensor(1.0)]).unsqueeze(1)
    torch.testing.assert_close(target, expected)
    assert (network.trunks, lagged.trunks) == (1, 1)


def test_the_monte_carlo_target_is_the_observed_return() -> None:
    assert torch.equal(ESTIMATORS["mc"].target(batch(), context(Slope(1), Slope(1))), batch().mc_return)


def test_the_table_has_the_papers_words() -> None:
    assert as_markdown().splitlines()[:8] == [
        "| `--algo` | target value | action selection |",
        "|---|---|---|",
        "| `supervised` | episode value, on synthetic actions | stochastic search |",
        "| `dql` | bootstrapped (double Q, lagged target network) | stochastic search |",
        "| `mc` | episode value | stochastic search |",
        "| `corr-mc` | corrected episode value, coefficient nu annealed 0 -> 1 | stochastic search |",
        "| `ddpg` | bootstrapped | actor network |",
        "| `pcl` | corrected episode value (Trust-PCL: relative entropy to a lagged policy) | actor network |",
    ]


def test_an_unknown_estimator_is_refused_with_the_choices() -> None:
    with pytest.raises(UserError, match=r"'sarsa' is unknown; choose from supervised, dql, mc, .*, or module:row"):
        estimator_named("sarsa")


OWN_ROW = """
import dataclasses
from graspq.train.estimators import ESTIMATORS
lazy = dataclasses.replace(ESTIMATORS["mc"], summary="Half of the return", target=lambda b, c: 0.5 * b.mc_return)
wrong = "mc"
"""


def test_a_users_own_row_is_found_in_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_estimators.py").write_text(OWN_ROW)
    monkeypatch.chdir(tmp_path)
    before = list(sys.path)
    row = estimator_named("own_estimators:lazy")
    assert row.summary == "Half of the return" and sys.path == before
    assert torch.equal(row.target(batch(), context(Slope(1), Slope(1))), 0.5 * batch().mc_return)
    with pytest.raises(UserError, match="own_estimators has str 'wrong'"):
        estimator_named("own_estimators:wrong")
    with pytest.raises(UserError, match="own_estimators has NoneType 'none'"):
        estimator_named("own_estimators:none")
    with pytest.raises(UserError, match=r"absent_estimators:row: cannot be imported .ModuleNotFoundError"):
        estimator_named("absent_estimators:row")


def test_a_users_own_row_trains_and_its_run_acts(
    settings: Callable[..., TrainSettings], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "trained_estimators.py").write_text(OWN_ROW)
    monkeypatch.chdir(tmp_path)
    run = train(settings("trained_estimators:lazy", steps=2))
    assert run.config["settings"]["algo"] == "trained_estimators:lazy"
    assert run.checkpoint().name == "step-00000002"
    named = settings("trained_estimators:lazy", out=None).run_folder
    assert named == Path("runs/trained_estimators-lazy-two-states-seed0")


def test_discounts_are_the_rows_own_the_datasets_or_those_given() -> None:
    assert ESTIMATORS["dql"].chosen_discount(None, 1.0) == 0.9
    assert ESTIMATORS["dql"].chosen_discount(0.0, 1.0) == 0.0
    assert ESTIMATORS["corr-mc"].chosen_discount(None, 1.0) == 0.9
    assert ESTIMATORS["mc"].chosen_discount(None, 1.0) == 1.0
    assert ESTIMATORS["mc"].chosen_discount(None, 0.95) == 0.95
    assert ESTIMATORS["mc"].chosen_discount(0.0, 1.0) == 0.0
    assert ESTIMATORS["supervised"].chosen_discount(None, 0.95) == 1.0
    with pytest.raises(UserError, match=r"--discount: .* have no discount, got 1; leave the option out"):
        ESTIMATORS["supervised"].chosen_discount(1.0, 1.0)


@pytest.mark.parametrize("loss", [cross_entropy, squared])
def test_the_best_constant_for_a_loss_is_the_mean_of_the_targets(loss: object) -> None:
    targets = torch.tensor([0.0, 0.0, 1.0, 0.6], dtype=torch.float64)
    outputs = torch.linspace(-3, 3, 60_001, dtype=torch.float64).unsqueeze(1)
    means = loss(outputs.expand(-1, 4), targets.expand(len(outputs), -1)).mean(1)  # type: ignore[operator]
    best = outputs[means.argmin()]
    q = best.sigmoid() if loss is cross_entropy else best
    torch.testing.assert_close(q, targets.mean().unsqueeze(0), rtol=0, atol=1e-4)


def test_the_squared_loss_is_half_the_squared_error() -> None:
    assert squared(torch.tensor([3.0]), torch.tensor([1.0])).item() == 2.0
