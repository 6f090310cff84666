"""Random changes of a batch that leave the value of its actions as it is: shifts, mirror images and other colours.

All states of an episode, and s and s' of a transition, are changed alike. Dimensions: B batch, T steps, H W C image.
"""

import dataclasses
import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

from graspq.train.batch import Batch
from graspq.train.views import mirrored_action, shifted

# Grey levels that are added, at most, for each unit of `--color`.
BRIGHTER = 60
ORDERS = torch.tensor(list(itertools.permutations(range(3))))


def augmented(
    batch: Batch, shift: int, mirror: Sequence[int] | None, generator: torch.Generator, color: float = 0.0
) -> Batch:
    """Return a batch with shifted images, half of them mirrored, in other colours.

    Args:
        batch: what the loader gave.
        shift: largest shift in pixels, along both axes; the border pixels are repeated.
        mirror: sign of each part of an action in the mirror image, in which columns are reversed; None: no mirroring.
        color: c; the channels change places, and of each, with g and b uniform in [-1, 1], the level is changed:

            out = (1 + c g) in + 60 c b,  clamped to 0 .. 255

            0: no change at all.
        generator: a CPU generator; how much is drawn depends on the number of rows alone.
    """
    rows, device = len(batch.action), batch.image.device
    shifts = torch.randint(-shift, shift + 1, (rows, 2), generator=generator).to(device)
    mirrored = (torch.rand(rows, generator=generator) < (0.0 if mirror is None else 0.5)).to(device)
    signs = mirror if mirror is not None else (1,) * batch.action.shape[-1]
    order = ORDERS[torch.randint(len(ORDERS), (rows,), generator=generator)].to(device)
    gain, bias = (2 * torch.rand(2, rows, 3, generator=generator) - 1).to(device)

    def change(image: Tensor) -> Tensor:
        moved = shifted(image, shifts, mirrored) if shift or mirror is not None else image
        return recolored(moved, order, 1 + color * gain, BRIGHTER * color * bias) if color else moved

    return dataclasses.replace(
        batch,
        image=change(batch.image),
        next_image=None if batch.next_image is None else change(batch.next_image),
        action=mirrored_action(batch.action, mirrored, signs),
        synthetic_action=mirrored_action(batch.synthetic_action, mirrored, signs),
    )


def recolored(image: Tensor, order: Tensor, gain: Tensor, bias: Tensor) -> Tensor:
    """Return images whose channel c is clamp(gain_c in[order_c] + bias_c), rounded down.

    Args:
        image: uint8 [B, T, H, W, 3].
        order: int64 [B, 3], which channel becomes which.
        gain: float32 [B, 3].
        bias: float32 [B, 3], grey levels.

    Returns:
        uint8 [B, T, H, W, 3].
    """
    rows = torch.arange(len(image), device=image.device).unsqueeze(1)
    # A channel at a time: along the last axis, of three, the same work takes twice as long.
    planes = image.reshape(len(image), -1, 3).transpose(1, 2).flatten(0, 1)
    levels = planes.index_select(0, (3 * rows + order).flatten()).float()
    levels = levels.mul_(gain.reshape(-1, 1)).add_(bias.reshape(-1, 1)).clamp_(0, 255).to(torch.uint8)
    return levels.view(len(image), 3, -1).transpose(1, 2).contiguous().view(image.shape)
