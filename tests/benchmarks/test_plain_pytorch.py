import copy

import pytest
import torch
from plain_pytorch import PlainTraining, augmented, plain_copy

from graspq.train.augment import mirrored_action, shifted
from graspq.train.networks import NetworkSpecification, make_network
from graspq.train.selection import uniform_actions, uniform_search
from graspq.train.settings import preset_settings
from graspq.train.state import seeded
from graspq.train.targets import bootstrapped

B, T = 6, 15


@pytest.fixture
def network():
    made = make_network(NetworkSpecification("default", (64, 64, 3), 4, T, "logistic"), seeded("tests/benchmarks"))
    # As after training: statistics that are not those of the start, and a step that matters.
    for name, tensor in made.state_dict().items():
        if name.endswith(("running_mean", "step_to_state.weight")):
            tensor.normal_(std=0.2, generator=seeded("tests/benchmarks/statistics"))
    return made


@pytest.fixture
def states():
    generator = seeded("tests/benchmarks/states")
    image = torch.randint(0, 256, (B, 64, 64, 3), dtype=torch.uint8, generator=generator)
    return image, torch.arange(B), torch.rand(B, 4, generator=generator) * 2 - 1


@pytest.mark.parametrize("training", [False, True])
def test_the_plain_network_gives_our_q(network, states, training):
    image, step, action = states
    plain = plain_copy(network, T - 1).train(training)
    with torch.no_grad():
        ours = network.train(training)(image, step, action)
        theirs = plain(image.permute(0, 3, 1, 2).contiguous().float(), step, action)
    assert ours.std() > 1e-3
    assert torch.allclose(ours, theirs, atol=1e-5, rtol=1e-5)


def test_the_plain_network_is_contiguous_float32(network):
    for tensor in plain_copy(network, T - 1).parameters():
        assert tensor.dtype == torch.float32
        assert tensor.is_contiguous()


def test_the_plain_augmentation_gives_our_pictures_and_actions(states):
    image, _, action = states
    shifts = torch.tensor([[-4, 4], [0, 0], [3, -2], [4, 4], [-1, 0], [2, 2]])
    mirrored = torch.tensor([True, False, True, False, False, True])
    ours = shifted(image.unsqueeze(1), shifts, mirrored).squeeze(1)
    moved = mirrored_action(action.unsqueeze(1), mirrored).squeeze(1)
    plain, plain_action = augmented(image.permute(0, 3, 1, 2), action, shifts.tolist(), mirrored.tolist(), 4)
    assert torch.equal(plain.permute(0, 2, 3, 1), ours.float())
    assert torch.equal(plain_action, moved)


@pytest.mark.parametrize("tiled", [False, True])
def test_the_plain_target_is_ours(network, states, tiled):
    image, step, _ = states
    settings = preset_settings("default", algo="dql", shards=("none",))
    plain = PlainTraining(plain_copy(network, T - 1), settings, 0.9, bootstrapped=True, tiled=tiled)
    terminal = torch.tensor([False, True, False, False, True, False])
    reward = torch.tensor([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    candidates = uniform_actions(seeded("tests/benchmarks/candidates"), B)
    network.eval()
    with torch.no_grad():
        q_of_actions = network.at(image, step)
        best = uniform_search(q_of_actions, candidates).action
        value = q_of_actions(best.unsqueeze(1))
    ours = bootstrapped(reward.unsqueeze(1), terminal.unsqueeze(1), value, 0.9).squeeze(1)
    batch = {"reward": reward, "terminal": terminal, "next_step": step}
    theirs = plain.double_q(batch, image.permute(0, 3, 1, 2).float(), candidates)
    assert torch.allclose(ours, theirs, atol=1e-5)


def test_a_plain_step_changes_weights_average_and_at_last_the_target_network(network, states):
    image, step, action = states
    settings = preset_settings("default", algo="mc", shards=("none",), lag_steps=2)
    plain = PlainTraining(plain_copy(network, T - 1), settings, 1.0, bootstrapped=False)
    before = copy.deepcopy(plain.network.state_dict())
    batch = {"image": image.permute(0, 3, 1, 2).contiguous(), "step": step, "action": action}
    plain.update(batch | {"mc_return": torch.ones(B)})
    weight = "hidden.weight"
    assert not torch.equal(plain.network.state_dict()[weight], before[weight])
    assert not torch.equal(plain.average.state_dict()[weight], before[weight])
    assert torch.equal(plain.target_network.state_dict()[weight], before[weight])
    plain.update(batch | {"mc_return": torch.ones(B)})
    assert torch.equal(plain.target_network.state_dict()[weight], plain.network.state_dict()[weight])
