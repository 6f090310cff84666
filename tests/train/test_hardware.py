"""The choice of device and arithmetic."""

import copy

import pytest
import torch
from torch import Tensor

from graspq.common.errors import UserError
from graspq.train.hardware import chosen_device, chosen_precision, keep_freed_memory
from graspq.train.networks import NetworkSpecification, make_network
from graspq.train.state import seeded

SPECIFICATION = NetworkSpecification("default", (16, 16, 3), 4, 15, "logistic")


def test_a_precision_that_was_asked_for_is_taken_and_its_autocast_does_what_it_says() -> None:
    network = make_network(SPECIFICATION, seeded("tests/weights"))
    for name, expected in (("float32", torch.float32), ("bfloat16", torch.bfloat16)):
        precision = chosen_precision(name, network, (16, 16, 3))  # type: ignore[arg-type]
        with precision.autocast():
            assert torch.nn.functional.linear(torch.ones(1, 2), torch.ones(1, 2)).dtype == expected


def test_the_probe_tries_both_and_leaves_the_network_as_it_was() -> None:
    network = make_network(SPECIFICATION, seeded("tests/weights"))
    before = copy.deepcopy(network.state_dict())
    precision = chosen_precision("auto", network, (16, 16, 3))
    assert set(precision.probe["milliseconds"]) == {"float32", "bfloat16"}
    faster = min(precision.probe["milliseconds"], key=precision.probe["milliseconds"].get)
    assert precision.name == faster
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())
    assert all(parameter.grad is None for parameter in network.parameters())


def test_bfloat16_that_gives_another_q_is_not_taken() -> None:
    network = make_network(SPECIFICATION, seeded("tests/weights"))

    def sensitive(module: torch.nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> Tensor:
        return output + (1.0 if torch.is_autocast_enabled("cpu") else 0.0)

    network.register_forward_hook(sensitive)
    assert chosen_precision("auto", network, (16, 16, 3)).name == "float32"


def test_a_gpu_that_is_not_there_is_refused() -> None:
    if torch.cuda.is_available():
        assert chosen_device("cuda").type == chosen_device("auto").type == "cuda"
    else:
        with pytest.raises(UserError, match="torch sees no GPU"):
            chosen_device("cuda")
        assert chosen_device("auto").type == "cpu"
    assert chosen_device("cpu").type == "cpu"


def test_keeping_freed_memory_does_no_harm() -> None:
    keep_freed_memory()
    assert float(torch.ones(1_000_000).sum()) == 1_000_000
