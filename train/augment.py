"""Random changes of a batch that leave the value of its actions as it is: shifts, and mirror images.

All states of an episode, and s and s' of a transition, are changed alike. Dimensions: B batch, T steps, H W C image.
"""

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from graspq.train.batch import Batch
from graspq.train.views import mirrored_action, shifted


def augmented(batch: Batch, shift: int, mirror: Sequence[int] | None, generator: torch.Generator) -> Batch:
    """Return a batch with shifted images, half of them mirrored.

    Args:
        batch: what the loader gave.
        shift: largest shift in pixels, along both axes; the border pixels are repeated.
        mirror: sign of each part of an action in the mirror image, in which columns are reversed; None: no mirroring.
        generator: a CPU generator; how much is drawn depends on the number of rows alone.
    """
    rows, device = len(batch.action), batch.image.device
    shifts = torch.randint(-shift, shift + 1, (rows, 2), generator=generator).to(device)
    mirrored = (torch.rand(rows, generator=generator) < (0.0 if mirror is None else 0.5)).to(device)
    signs = mirror if mirror is not None else (1,) * batch.action.shape[-1]

    def change(image: Tensor) -> Tensor:
        return shifted(image, shifts, mirrored) if shift or mirror is not None else image

    return dataclasses.replace(
        batch,
        image=change(batch.image),
        next_image=None if batch.next_image is None else change(batch.next_image),
        action=mirrored_action(batch.action, mirrored, signs),
        synthetic_action=mirrored_action(batch.synthetic_action, mirrored, signs),
    )
