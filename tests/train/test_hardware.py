"""The choice of device and arithmetic."""

import copy
from typing import Any

import pytest
import torch
from torch import Tensor

from graspq.common.errors import UserError
from graspq.train import hardware
from graspq.train.hardware import (
    Precision,
    PrecisionName,
    _faster_compiled,
    chosen_compilation,
    chosen_device,
    chosen_precision,
    compile_networks,
    keep_freed_memory,
)
from graspq.train.networks import NetworkSpecification, QNetwork, make_network
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


def test_a_compiled_network_gives_the_same_q_and_keeps_the_names_of_its_weights() -> None:
    plain = make_network(SPECIFICATION, seeded("tests/weights"))
    compiled = copy.deepcopy(plain)
    compile_networks([compiled], backend="eager")
    image = torch.randint(0, 256, (3, 16, 16, 3), dtype=torch.uint8, generator=seeded("tests/images"))
    state = image, torch.tensor([0, 1, 2])
    action = torch.rand(3, 5, 4, generator=seeded("tests/actions")) * 2 - 1
    with torch.no_grad():
        torch.testing.assert_close(compiled.eval().at(*state)(action), plain.eval().at(*state)(action))
    assert list(compiled.state_dict()) == list(plain.state_dict())


def test_on_a_cpu_networks_are_compiled_only_where_asked() -> None:
    network, precision = make_network(SPECIFICATION, seeded("tests/weights")), Precision("float32", torch.device("cpu"))
    answers = [chosen_compilation(asked, network, precision, (16, 16, 3))[0] for asked in ("auto", "yes", "no")]
    assert answers == [False, True, False]


def test_a_compiler_that_fails_is_not_taken_and_the_reason_is_kept() -> None:
    network, precision = make_network(SPECIFICATION, seeded("tests/weights")), Precision("float32", torch.device("cpu"))

    def broken(graph: object, inputs: object) -> object:
        raise RuntimeError("no compiler here")

    taken, probe = _faster_compiled(network, precision, (16, 16, 3), broken)  # type: ignore[arg-type]
    assert not taken and "no compiler here" in probe["failed"]


@pytest.mark.parametrize(("compiled_seconds", "faster"), [(0.25, True), (0.5, False), (0.75, False)])
def test_what_is_compiled_right_is_taken_where_it_is_faster_and_the_network_stays_as_it_was(
    monkeypatch: pytest.MonkeyPatch, compiled_seconds: float, faster: bool
) -> None:
    network, precision = make_network(SPECIFICATION, seeded("tests/weights")), Precision("float32", torch.device("cpu"))
    before, measured = copy.deepcopy(network.state_dict()), hardware._trial

    def timed(tried: QNetwork, *settings: Any) -> tuple[Tensor, float]:
        return measured(tried, *settings)[0], compiled_seconds if "trunk" in vars(tried) else 0.5

    monkeypatch.setattr(hardware, "_trial", timed)
    taken, probe = _faster_compiled(network, precision, (16, 16, 3), "eager")
    assert taken is faster
    assert probe["milliseconds"] == {"plain": 500.0, "compiled": 1000 * compiled_seconds}
    assert probe["asked"] == "auto" and 0 <= probe["root_mean_square_difference"] < 1e-5
    assert "trunk" not in vars(network) and all(parameter.grad is None for parameter in network.parameters())
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())


@pytest.mark.parametrize(
    ("name", "off", "right"),
    [
        ("float32", 0.009, True),
        ("float32", 0.011, False),
        ("bfloat16", 0.29, True),
        ("bfloat16", 0.31, False),
        ("float32", float("nan"), False),
    ],
)
def test_on_a_gpu_compiled_networks_whose_q_is_off_by_more_than_the_tolerance_are_not_taken_however_fast(
    monkeypatch: pytest.MonkeyPatch, name: PrecisionName, off: float, right: bool
) -> None:
    network, q = make_network(SPECIFICATION, seeded("tests/weights")), torch.linspace(0.3, 0.4, 64)

    def given(tried: QNetwork, *settings: Any) -> tuple[Tensor, float]:
        return (q + off * q.std(), 0.001) if "trunk" in vars(tried) else (q, 1.0)

    monkeypatch.setattr(hardware, "_trial", given)
    precision = Precision(name, torch.device("cuda"))
    taken, probe = chosen_compilation("auto", network, precision, (16, 16, 3), "eager")
    assert taken is right
    difference = probe["root_mean_square_difference"]
    assert isinstance(difference, float if right else str)
    assert float(difference) == pytest.approx(off * float(q.std()), rel=1e-3, nan_ok=True)
