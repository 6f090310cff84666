"""The choice of device and arithmetic."""

import pytest
import torch

from graspq.common.errors import UserError
from graspq.train.device import chosen_device, chosen_precision, prepare

CPU = torch.device("cpu")


@pytest.mark.parametrize(("name", "expected"), [("float32", torch.float32), ("bfloat16", torch.bfloat16)])
def test_a_precision_that_was_asked_for_is_taken_and_its_autocast_does_what_it_says(
    name: str, expected: torch.dtype
) -> None:
    with chosen_precision(name, CPU).autocast():  # type: ignore[arg-type]
        assert torch.nn.functional.linear(torch.ones(1, 2), torch.ones(1, 2)).dtype == expected


@pytest.mark.parametrize(
    ("capabilities", "name"),
    [
        ({}, "float32"),
        ({"avx512_f": True}, "float32"),
        ({"avx512_bf16": True}, "bfloat16"),
        ({"amx_bf16": True}, "bfloat16"),
    ],
)
def test_auto_is_bfloat16_on_a_cpu_that_has_instructions_for_it_alone(
    monkeypatch: pytest.MonkeyPatch, capabilities: dict[str, bool], name: str
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities)
    assert chosen_precision("auto", CPU).name == name


def test_a_gpu_that_is_not_there_is_refused() -> None:
    if torch.cuda.is_available():
        assert chosen_device("cuda").type == chosen_device("auto").type == "cuda"
    else:
        with pytest.raises(UserError, match="torch sees no GPU"):
            chosen_device("cuda")
        assert chosen_device("auto").type == "cpu"
    assert chosen_device("cpu").type == "cpu"


def test_threads_are_set_where_they_are_given() -> None:
    before = torch.get_num_threads()
    try:
        prepare(2)
        prepare(None)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
