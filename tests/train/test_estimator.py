"""The table of estimators, and the targets of `mc` and `dql` on Q-functions whose values are known."""

import itertools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from plain import plain_networks
from torch import Tensor, nn

from graspq.common.errors import UserError
from graspq.datasets.dataset import open_shards
from graspq.train.batch import Batch
from graspq.train.batches import training_batches
from graspq.train.estimator import cross_entropy, huber, squared
from graspq.train.estimators import ESTIMATORS, as_markdown, dql, estimator_named, mc
from graspq.train.loop import update
from graspq.train.networks.network import Features, QNetwork
from graspq.train.selection import uniform_actions
from graspq.train.session import session
from graspq.train.settings import TrainSettings
from graspq.train.state import seeded


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


def target_of(row: str, online: QNetwork, lagged: QNetwork) -> Tensor:
    chosen = ESTIMATORS[row]
    networks = plain_networks({"q": online}, {"q": lagged})
    return chosen.target_value.target(batch(), networks, chosen.settings(), seeded("tests/draws"), 0.0)


def test_the_double_q_target_lets_the_network_pick_and_the_lagged_one_judge() -> None:
    network, lagged = Slope(1.0), Slope(-2.0)
    target = target_of("dql", network, lagged)
    drawn = uniform_actions(seeded("tests/draws"), 2, 16, 4)
    largest_dx = drawn[0, :, 0].max()
    expected = torch.stack([0.9 * (-2.0 * largest_dx + 1), torch.tensor(1.0)]).unsqueeze(1)
    torch.testing.assert_close(target, expected)
    assert (network.trunks, lagged.trunks) == (1, 1)


def test_states_after_a_last_step_are_asked_of_no_network() -> None:
    image, step = batch().next_states
    assert (len(image), step.tolist()) == (1, [1])
    assert batch().before(torch.tensor([[0.5]])).tolist() == [[0.5], [0.0]]


def test_the_monte_carlo_target_is_the_observed_return() -> None:
    assert torch.equal(target_of("mc", Slope(1), Slope(1)), batch().mc_return)


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
lazy = dataclasses.replace(ESTIMATORS["mc"], summary="Half of the return")
wrong = "mc"
"""


def test_a_users_own_row_is_found_in_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_rows.py").write_text(OWN_ROW)
    monkeypatch.chdir(tmp_path)
    before = list(sys.path)
    row = estimator_named("own_rows:lazy")
    assert row.summary == "Half of the return" and sys.path == before
    with pytest.raises(UserError, match="--algo own_rows:wrong: expected Estimator, got str"):
        estimator_named("own_rows:wrong")
    with pytest.raises(UserError, match="own_rows has no 'none'"):
        estimator_named("own_rows:none")
    with pytest.raises(UserError, match=r"absent_rows:row: cannot be imported, ModuleNotFoundError"):
        estimator_named("absent_rows:row")


def test_discounts_are_the_rows_own_the_datasets_or_those_given() -> None:
    for name in set(ESTIMATORS) - {"supervised", "mc"}:
        assert ESTIMATORS[name].settings().chosen_discount(1.0) == (0.8 if name in ("corr-mc", "mc-floor") else 0.9)
    assert dql.DqlSettings(discount=0.0).chosen_discount(1.0) == 0.0
    assert [mc.McSettings().chosen_discount(stored) for stored in (1.0, 0.95)] == [1.0, 0.95]
    assert mc.McSettings(discount=0.0).chosen_discount(1.0) == 0.0
    assert ESTIMATORS["supervised"].settings().chosen_discount(0.95) == 1.0


@pytest.mark.parametrize("loss", [cross_entropy, squared, huber])
def test_the_best_constant_for_a_loss_is_the_mean_of_the_targets(loss: object) -> None:
    targets = torch.tensor([0.0, 0.0, 1.0, 0.6], dtype=torch.float64)
    outputs = torch.linspace(-3, 3, 60_001, dtype=torch.float64).unsqueeze(1)
    means = loss(outputs.expand(-1, 4), targets.expand(len(outputs), -1)).mean(1)  # type: ignore[operator]
    best = outputs[means.argmin()]
    q = best.sigmoid() if loss is cross_entropy else best
    torch.testing.assert_close(q, targets.mean().unsqueeze(0), rtol=0, atol=1e-4)


def test_the_squared_loss_is_half_the_squared_error() -> None:
    assert squared(torch.tensor([3.0]), torch.tensor([1.0])).item() == 2.0


def test_the_huber_loss_is_the_squared_one_up_to_an_error_of_one_and_then_grows_by_the_error() -> None:
    errors = torch.tensor([-3.0, -1.0, -0.5, 0.0, 0.8, 1.0, 2.0])
    expected = torch.tensor([2.5, 0.5, 0.125, 0.0, 0.32, 0.5, 1.5])
    torch.testing.assert_close(huber(errors + 0.25, torch.full((7,), 0.25)), expected)


PICKED_AND_JUDGED = ["lagged-q by running", "q by batch", "q by running"]
# Every pass of an update through a network, and whose statistics its batch normalisation uses.
PASSES = {
    "supervised": ["q by batch"],
    "dql": PICKED_AND_JUDGED,
    "mc": ["q by batch"],
    "corr-mc": PICKED_AND_JUDGED,
    "ddpg": ["actor by batch", "lagged-actor by running", "lagged-q by running", "q by batch", "q by running"],
    # The first pass of its actor only notes the batch's statistics in the running ones.
    "pcl": ["actor by batch", "actor by running", "lagged-actor by running", "v by batch"],
    "nstep": PICKED_AND_JUDGED,
    "td-lambda": PICKED_AND_JUDGED,
    "mc-floor": PICKED_AND_JUDGED,
    "blend": PICKED_AND_JUDGED,
    "iql": ["lagged-q by running", "q by batch", "v by batch", "v by running"],
    "td3-bc": [
        "actor by batch",
        "lagged-actor by running",
        "lagged-q by running",
        "lagged-twin by running",
        "q by batch",
        "q by running",
        "twin by batch",
    ],
}


def watch(networks: dict[str, nn.Module]) -> list[str]:
    """Return a list that every pass through a network from now on is added to."""
    passes: list[str] = []
    for name, network in networks.items():

        def note(*_: object, name: str = name, network: nn.Module = network) -> None:
            by_batch = any(module.training for module in network.modules())
            passes.append(f"{name} by {'batch' if by_batch else 'running'}")

        first = next(module for module in network.modules() if isinstance(module, nn.BatchNorm2d))
        first.register_forward_pre_hook(note)
    return passes


OWN: dict[str, dict[str, Any]] = {
    "ddpg": {"actor_rest": 0.0, "actor_every": 1},
    "td3-bc": {"actor_every": 1},
    "corr-mc with its gradient": {"judge": "online-gradient", "loss": "squared"},
    "iql with its actor": {"policy": "actor"},
}
PASSES |= {
    "corr-mc with its gradient": PICKED_AND_JUDGED,
    "iql with its actor": ["actor by batch", *PASSES["iql"]],
}


@pytest.mark.parametrize("name", [*ESTIMATORS, "corr-mc with its gradient", "iql with its actor"])
def test_target_search_and_evaluation_passes_never_use_batch_statistics(
    settings: Callable[..., TrainSettings], name: str
) -> None:
    # Without averaged networks the trained ones are judged too.
    algo, own = name.split()[0], OWN.get(name, {})
    chosen = settings(algo, steps=2, average_decay=0.0, batch_size=8, **own)
    pool = open_shards(chosen.shards)
    training, held_back = pool.split(chosen.validation_fraction, chosen.seed)
    with session(chosen, pool, training, held_back) as current:
        passes = watch(current.state.named_networks)
        with training_batches(training, chosen, torch.device("cpu"), 0) as batches:
            for batch in itertools.islice(batches, 2):
                update(current, batch)
                assert sorted(passes) == PASSES[name]
                passes.clear()
        assert current.validate() is not None
        assert len(passes) >= 2 and all(name.endswith("by running") for name in passes), passes
