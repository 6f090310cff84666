"""Networks: split heads against unsplit ones, trunks that run once, batch normalisation that stays as it is."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from plain import specification
from torch import Tensor, nn
from torch.nn import functional

from graspq.common.action_space import ActionSpace
from graspq.common.errors import UserError
from graspq.train.networks import NETWORKS, build, network_named, q_network, state_network
from graspq.train.networks.default import DefaultNetwork
from graspq.train.networks.network import QNetwork
from graspq.train.networks.paper import PaperNetwork
from graspq.train.state import seeded

BATCH, CANDIDATES = 3, 5


def make_network(name: str, size: int = 64, weights: int = 0, **given: Any) -> QNetwork:
    network = build(q_network, specification(name, size, **given), seeded("tests/weights", weights))
    assert isinstance(network, QNetwork)
    return network


def make_state_network(name: str, outputs: int = 8) -> nn.Module:
    return build(state_network(outputs), specification(name, 64), seeded("tests/weights"))


def made(name: str, size: int = 64) -> QNetwork:
    """A network in evaluation mode with weights, gains and statistics away from their special starting values."""
    network = make_network(name, size).train()
    generator = seeded("tests/shake")
    for parameter in network.parameters():
        parameter.data += 0.1 * (torch.rand(parameter.shape, generator=generator) - 0.5)
    with torch.no_grad():
        for _ in range(30):
            network.trunk(*states(size)[:2])
    return network.eval()


def states(size: int = 64) -> tuple[Tensor, Tensor, Tensor]:
    generator = seeded("tests/states")
    image = torch.randint(0, 256, (BATCH, size, size, 3), dtype=torch.uint8, generator=generator)
    return image, torch.tensor([0, 3, 14]), torch.rand(BATCH, CANDIDATES, 4, generator=generator) * 2 - 1


@pytest.fixture(params=list(NETWORKS))
def network(request: pytest.FixtureRequest) -> Iterator[QNetwork]:
    yield made(request.param)


@torch.no_grad()
def test_the_head_on_trunk_features_equals_the_whole_network_on_each_action(network: QNetwork) -> None:
    image, step, action = states()
    features = network.trunk(image, step)
    together = network.head(features, action)
    assert together.shape == (BATCH, CANDIDATES) and together.dtype == torch.float32
    for index in range(CANDIDATES):
        alone = network(image, step, action[:, index])
        torch.testing.assert_close(together[:, index], alone, rtol=1e-5, atol=1e-5)
    assert float(together.std(dim=1).min()) > 1e-4, "the action makes no difference"
    assert float(together.std(dim=0).min()) > 1e-4, "the state makes no difference"


@torch.no_grad()
def test_the_paper_network_equals_its_unsplit_form() -> None:
    network = made("paper")
    assert isinstance(network, PaperNetwork)
    image, step, action = states()
    state_map = network.map(image, step)
    assert state_map.shape == (BATCH, 33, 7, 7)
    for index in range(CANDIDATES):
        embedding = network.action_norm(network.action(action[:, index]))
        joined = state_map + embedding.view(BATCH, 33, 1, 1)
        hidden = network.first_norm(network.first(joined.flatten(1)))
        expected = network.last(network.second_norm(network.second(hidden))).squeeze(1)
        split = network(image, step, action[:, index])
        torch.testing.assert_close(split, expected, rtol=1e-5, atol=1e-5)


def test_the_paper_network_has_the_papers_sizes() -> None:
    network = make_network("paper")
    shapes = {name: list(value.shape) for name, value in network.named_parameters() if value.dim() > 1}
    assert shapes == {
        "map.convolutions.0.weight": [32, 3, 3, 3],
        "map.convolutions.1.weight": [32, 32, 3, 3],
        "map.convolutions.2.weight": [32, 32, 3, 3],
        "action.weight": [33, 4],
        "first.weight": [32, 33 * 7 * 7],
        "second.weight": [32, 32],
        "last.weight": [1, 32],
    }
    assert sum(parameter.numel() for parameter in network.parameters()) == 72_615
    weights = torch.cat([value.detach().flatten() for value in network.parameters() if value.dim() > 1])
    assert float(weights.abs().max()) <= 0.02 and 0.0085 < float(weights.std()) < 0.009


@torch.no_grad()
def test_layer_normalisation_of_the_paper_network_is_over_height_width_and_channels() -> None:
    network = make_network("paper")
    assert isinstance(network, PaperNetwork)
    x = torch.rand(2, 32, 5, 5, generator=seeded("tests/x"))
    expected = functional.relu(functional.layer_norm(x, [32, 5, 5], eps=1e-12))
    torch.testing.assert_close(network.map.norms[0](x), expected, rtol=1e-5, atol=1e-5)


@torch.no_grad()
def test_candidates_never_run_the_trunk_again(network: QNetwork) -> None:
    runs = []
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            module.register_forward_hook(lambda *_: runs.append(1))
    image, step, action = states()
    q_of_actions = network.at(image, step)
    convolutions = len(runs)
    assert convolutions >= 3
    for _ in range(3):
        q_of_actions(action)
    assert len(runs) == convolutions


@torch.no_grad()
def test_evaluation_passes_leave_batch_statistics_alone_and_do_not_use_the_batchs() -> None:
    network = made("default")
    before = {name: buffer.clone() for name, buffer in network.named_buffers()}
    image, step, action = states()
    together = network(image, step, action[:, 0])
    alone = torch.cat([network(image[i : i + 1], step[i : i + 1], action[i : i + 1, 0]) for i in range(BATCH)])
    torch.testing.assert_close(together, alone, rtol=1e-5, atol=1e-5)
    for name, buffer in network.named_buffers():
        assert torch.equal(buffer, before[name]), name


def test_q_is_a_probability_with_the_logistic_link_and_the_raw_output_without() -> None:
    image, step, action = states()
    for link in ("logistic", "identity"):
        network = make_network("paper", link=link).eval()
        raw = network(image, step, action[:, 0])
        q = network.at(image, step)(action[:, :1]).squeeze(1)
        torch.testing.assert_close(q, raw.sigmoid() if link == "logistic" else raw)


def test_initial_weights_are_a_function_of_the_seed_alone() -> None:
    torch.manual_seed(1)
    first = make_network("default").state_dict()
    torch.manual_seed(2)
    again = make_network("default").state_dict()
    other = make_network("default", weights=1).state_dict()
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["last.weight"], other["last.weight"])


@pytest.mark.parametrize("name", list(NETWORKS))
def test_filters_of_a_fresh_network_lie_channels_last_in_memory_as_the_images_do(name: str) -> None:
    for network in (make_network(name), make_state_network(name)):
        filters = [weights for weights in network.parameters() if weights.dim() == 4]
        assert all(weights.is_contiguous(memory_format=torch.channels_last) for weights in filters)
        # Filters of one pixel or one channel lie both ways.
        assert sum(not weights.is_contiguous() for weights in filters) >= 3


@pytest.mark.parametrize(("name", "size"), [("default", 20), ("default", 8), ("paper", 14)])
def test_images_that_a_network_cannot_take_are_refused_in_one_line(name: str, size: int) -> None:
    with pytest.raises(UserError, match="images of"):
        make_network(name, size)


def test_an_unknown_network_is_refused_with_the_choices() -> None:
    with pytest.raises(UserError, match="choose from default, paper"):
        make_network("resnet")


@torch.no_grad()
def test_keypoints_are_the_expected_positions_of_their_heat() -> None:
    network = made("default")
    assert isinstance(network, DefaultNetwork)
    keypoints = network.encoder.keypoints
    x = torch.zeros(1, 64, 16, 16)
    x[0, 0, 3, 12] = 1.0
    keypoints.heat.weight.zero_()
    keypoints.heat.weight[:, 0] = 1e4
    points = keypoints(x).view(-1, 2)
    expected = torch.tensor([12 / 15 * 2 - 1, 3 / 15 * 2 - 1]).expand(16, 2)
    torch.testing.assert_close(points, expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(keypoints(torch.zeros_like(x)), torch.zeros(1, 32), rtol=0, atol=1e-6)


@torch.no_grad()
def test_a_look_reads_the_map_where_the_action_leads() -> None:
    network = made("default")
    assert isinstance(network, DefaultNetwork)
    network.displacement.weight.zero_()
    network.displacement.weight[0, 0] = 2 / 15  # dx of 1 moves the first look by one pixel of the map
    network.looks_to_hidden.weight.zero_()
    network.looks_to_hidden.weight[:, 0] = 1.0
    network.action_to_hidden.weight.zero_()
    state, where = torch.zeros(1, 256), torch.zeros(1, 8)
    where[0, :2] = torch.tensor([5 / 15 * 2 - 1, 9 / 15 * 2 - 1])
    local = torch.zeros(1, 32, 16, 16)
    local[0, 0, 9, 6] = 3.0

    def seen(dx: float) -> float:
        """The feature of the first look, recovered from the output, in which it is piecewise linear."""
        return float(network.head((state, where, local), torch.tensor([[[dx, 0.0, 0.0, 0.0]]])))

    network.hidden.weight.fill_(1 / 256)
    network.hidden.bias.zero_()
    network.last.weight.fill_(1 / 128)
    network.last.bias.zero_()
    assert [seen(dx) for dx in (0.0, 0.5, 1.0, 2.0)] == pytest.approx([0.0, 1.5, 3.0, 0.0], abs=1e-5)


@pytest.mark.parametrize("name", list(NETWORKS))
def test_a_function_of_the_state_has_the_asked_outputs_and_reads_image_and_step(name: str) -> None:
    network = make_state_network(name)
    generator = seeded("tests/shake")
    for parameter in network.parameters():
        parameter.data += 0.1 * (torch.rand(parameter.shape, generator=generator) - 0.5)
    image, step, _ = states()
    with torch.no_grad():
        outputs = network.eval()(image, step)
        later = network(image, (step + 5).clamp(max=14))
    assert outputs.shape == (BATCH, 8) and outputs.dtype == torch.float32
    assert float(outputs.std(dim=0).min()) > 1e-4
    assert float((outputs[:2] - later[:2]).abs().max()) > 1e-4 and torch.equal(outputs[2], later[2])


@pytest.mark.parametrize("name", list(NETWORKS))
@torch.no_grad()
def test_actions_have_as_many_parts_as_their_space(name: str) -> None:
    space = ActionSpace(tuple("abcde"), tuple("vwxyz"), ("m",) * 5, (0.1,) * 5, None, (0.0,) * 5)
    network = make_network(name, action=space).eval()
    image, step, _ = states()
    action = torch.rand(BATCH, CANDIDATES, 5, generator=seeded("tests/five")) * 2 - 1
    assert network.at(image, step)(action).shape == (BATCH, CANDIDATES)
    # The fifth part matters, however little at first.
    changed = action + torch.tensor([0.0, 0.0, 0.0, 0.0, 0.5])
    raw, other = (network.head(network.trunk(image, step), one) for one in (action, changed))
    assert not torch.equal(raw, other)


def test_the_papers_network_has_the_width_that_its_option_says() -> None:
    network = make_network("paper", settings={"width": 8})
    assert isinstance(network, PaperNetwork)
    assert network.first.weight.shape == (8, 9 * 7 * 7) and network.last.weight.shape == (1, 8)


OWN_FAMILY = """
from graspq.train.networks.network import NetworkFamily
from graspq.train.networks.paper import PaperNetwork, PaperNetworkSettings, PaperStateNetwork
family = NetworkFamily(PaperNetwork, PaperStateNetwork, PaperNetworkSettings)
wrong = PaperNetwork
"""


def test_a_users_own_family_is_found_in_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_networks.py").write_text(OWN_FAMILY)
    monkeypatch.chdir(tmp_path)
    assert network_named("own_networks:family").q is PaperNetwork
    assert isinstance(make_network("own_networks:family"), PaperNetwork)
    with pytest.raises(UserError, match="--network own_networks:wrong: expected NetworkFamily, got type"):
        network_named("own_networks:wrong")
