"""The rivals of training compute what ours computes, and one that does not is refused."""

import pytest
import torch

from graspq.benchmarks import training
from graspq.benchmarks.plain_pytorch import PlainTraining, plain_copy
from graspq.benchmarks.sessions import ready, training_of
from graspq.common.errors import UserError
from graspq.datasets.dataset import open_shards
from graspq.train.state import seeded


@pytest.fixture(scope="module")
def shards_of_64_pixels(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A hundred drawn episodes; the plain network takes pictures of 64 × 64 pixels alone."""
    from drawn_data import make_dataset

    folder = tmp_path_factory.mktemp("data") / "drawn"
    make_dataset(folder, blocks=70, per_shard=35, size=64)
    return str(folder)


@pytest.fixture(scope="module", params=["mc", "dql"])
def ours(request, shards_of_64_pixels):
    """A session whose weights are as after training: statistics that are not those of the start."""
    pool = open_shards([shards_of_64_pixels])
    with training_of(request.param, [shards_of_64_pixels], pool, batch_size=8) as current:
        for network in (*current.state.networks.online.values(), *current.state.networks.lagged.values()):
            for name, tensor in network.state_dict().items():
                if name.endswith(("running_mean", "step_to_state.weight")):
                    tensor.normal_(std=0.2, generator=seeded("tests/benchmarks/statistics"))
        yield current, ready(current, pool, 1)[0]


def plain(current, tiled=False):
    network = plain_copy(current.state.networks.q, current.state.networks.specification.steps - 1)
    return PlainTraining(network, current.settings, tiled)


@pytest.mark.parametrize("tiled", [False, True])
def test_plain_training_has_our_pictures_q_and_target(ours, tiled):
    training.check_agreement(ours[0], plain(ours[0], tiled), ours[1])


@pytest.mark.parametrize("part", ["last", "looks_to_hidden", "where", "step_to_state"])
def test_a_plain_network_with_other_weights_is_refused(ours, part):
    rival = plain(ours[0])
    with torch.no_grad():
        getattr(rival.network, part).weight.mul_(1.5)
    with pytest.raises(UserError, match=r"of plain .* differs from ours"):
        training.check_agreement(ours[0], rival, ours[1])


def test_a_plain_target_with_another_discount_is_refused(ours, monkeypatch):
    current, batch = ours
    if current.settings.algo != "dql":
        pytest.skip("mc has no target of its own")
    double_q = PlainTraining.double_q
    monkeypatch.setattr(PlainTraining, "double_q", lambda *given: double_q(*given[:-1], 0.99))
    with pytest.raises(UserError, match="the target of plain dql"):
        training.check_agreement(current, plain(current), batch)


def test_a_plain_step_changes_weights_and_average_and_of_dql_at_last_the_lagged_network(ours):
    current, batch = ours
    rival = plain(current)
    taken = training.plain_batch(batch)
    before = {name: tensor.clone() for name, tensor in rival.network.state_dict().items()}
    rival.update(taken)
    weight = "hidden.weight"
    assert not torch.equal(rival.network.state_dict()[weight], before[weight])
    assert not torch.equal(rival.average.state_dict()[weight], before[weight])
    assert torch.equal(rival.lagged.state_dict()[weight], before[weight])
    if rival.dql is not None:
        rival.step = rival.dql.lag_steps - 1
        rival.update(taken)
        assert torch.equal(rival.lagged.state_dict()[weight], rival.network.state_dict()[weight])


def test_every_piece_of_a_step_is_timed_and_the_networks_share_is_of_a_whole_step(ours):
    row = training.pieces_row(ours[0], [ours[1]] * 4)
    pieces = {name.removesuffix(" (ms)"): value for name, value in row.items() if name.endswith("(ms)")}
    assert set(pieces) == {"step", "augmentation", "target", "forward", "backward", "optimiser", "averages"}
    assert min(pieces.values()) > 0 and pieces["step"] > pieces["optimiser"]
    share = (pieces["forward"] + pieces["backward"]) / pieces["step"]
    assert row["share of forward and backward"] == f"{share:.0%}"
