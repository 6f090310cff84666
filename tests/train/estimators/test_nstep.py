"""`nstep` and `td-lambda`: their targets from networks and batches, and that their ends are those of `dql` and `mc`."""

from collections.abc import Iterator
from typing import Any

import pytest
import tiny_mdp
import torch
from plain import plain_networks
from tiny_training import tiny_networks, tiny_settings
from torch import Tensor

from graspq.train.batch import Batch
from graspq.train.estimators import ESTIMATORS
from graspq.train.networks.network import Features, QNetwork
from graspq.train.state import Networks, seeded

DATA = tiny_mdp.collect(40, seed=1)
EPISODES = DATA.whole_episodes(torch.arange(40))


class Tilted(QNetwork):
    """Q(s, a) = factor · dx + (step + brightness) / 8: a value of the state, and one action that is the best."""

    link = "identity"

    def __init__(self, factor: float) -> None:
        super().__init__()
        self.factor = factor

    def trunk(self, image: Tensor, step: Tensor) -> Features:
        return ((step + image[:, 2, 0, 0] / 200) / 8,)

    def head(self, features: Features, action: Tensor) -> Tensor:
        return self.factor * action[..., 0] + features[0].unsqueeze(1)


@pytest.fixture(autouse=True, scope="module")
def networks() -> Iterator[None]:
    with tiny_networks():
        yield


def target_of(algo: str, batch: Batch, lagged: float = 0.0, online: float = 0.0, **own: Any) -> Tensor:
    given: Networks = plain_networks({"q": Tilted(online)}, {"q": Tilted(lagged)})
    chosen = tiny_settings(algo=algo, **own).own
    return ESTIMATORS[algo].target_value.target(batch, given, chosen, seeded("tests/draws"), 0.0)


def real(values: Tensor) -> Tensor:
    return EPISODES.real(values)


@pytest.mark.parametrize("own", [{"algo": "nstep", "n": 1}, {"algo": "td-lambda", "trace_decay": 0.0}], ids=str)
def test_the_near_end_is_exactly_dql(own: dict[str, Any]) -> None:
    one_by_one = target_of("dql", DATA.transitions(torch.arange(DATA.rows)))
    torch.testing.assert_close(real(target_of(batch=EPISODES, **own)), one_by_one.squeeze(1), rtol=0, atol=1e-6)


@pytest.mark.parametrize("own", [{"algo": "nstep", "n": 15}, {"algo": "td-lambda", "trace_decay": 1.0}], ids=str)
def test_the_far_end_is_exactly_mc_with_the_same_discount(own: dict[str, Any]) -> None:
    observed = target_of("mc", EPISODES, discount=0.9)
    torch.testing.assert_close(real(target_of(batch=EPISODES, **own)), real(observed), rtol=0, atol=1e-6)


def test_n_steps_are_counted_and_td_lambda_is_their_mean() -> None:
    by_n = [real(target_of("nstep", EPISODES, n=n)) for n in range(1, 16)]
    weights = [0.3 * 0.7 ** (n - 1) for n in range(1, 15)]
    mean = sum((w * y for w, y in zip(weights, by_n, strict=False)), 0.7**14 * by_n[-1])
    torch.testing.assert_close(real(target_of("td-lambda", EPISODES, trace_decay=0.7)), mean)
    assert all(float((by_n[n] - by_n[n - 1]).abs().max()) > 0.01 for n in (1, 2))


@pytest.mark.parametrize("own", [{"algo": "nstep", "n": 2}, {"algo": "td-lambda", "trace_decay": 0.5}], ids=str)
def test_the_online_network_picks_and_the_lagged_one_judges(own: dict[str, Any]) -> None:
    plain = target_of(batch=EPISODES, **own)
    higher = target_of(batch=EPISODES, lagged=1.0, online=1.0, **own)
    lower = target_of(batch=EPISODES, lagged=1.0, online=-1.0, **own)
    reads_v = plain != target_of("mc", EPISODES, discount=0.9)
    assert bool(reads_v.any())
    assert bool((higher > plain)[reads_v].all()) and bool((lower < plain)[reads_v].all())
    assert torch.equal(plain, target_of(batch=EPISODES, lagged=0.0, online=1.0, **own)), "the picker's Q is no value"
