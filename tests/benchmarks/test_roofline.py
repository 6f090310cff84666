"""Operations a second of training, and of the matrix product that they are held against."""

import torch
from roofline import operations, roof


def test_operations_are_counted_forward_and_backward() -> None:
    layer, x = torch.nn.Linear(30, 20, bias=False), torch.randn(10, 30)
    assert operations(lambda: layer(x)) == 2 * 10 * 30 * 20
    # Backward: a product for the weights alone, for the input needs no gradient.
    assert operations(lambda: layer(x).sum().backward()) == 2 * 2 * 10 * 30 * 20


def test_the_roof_is_that_of_a_computer() -> None:
    assert 1e8 < roof(torch.device("cpu"), "float32", repeats=1) < 1e14
