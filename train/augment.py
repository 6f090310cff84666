"""Random changes of a batch that leave the value of its actions as it is: shifts, and mirror images.

All states of an episode, and s and s' of a transition, are changed alike. Dimensions: B batch, T steps, H W C image.
"""

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from graspq.train.batch import Batch


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


def shifted(image: Tensor, shift: Tensor, mirrored: Tensor) -> Tensor:
    """Shift images and reverse the columns of some, by index alone: no grey level is computed anew.

        out[i, j] = in[clamp(i + shift₀), clamp(j' + shift₁)],  j' = W - 1 - j where mirrored, else j

    Args:
        image: uint8 [B, T, H, W, C].
        shift: int64 [B, 2], pixels along rows and columns.
        mirrored: bool [B].

    Returns:
        uint8 [B, T, H, W, C].
    """
    batch, steps, height, width, channels = image.shape
    device = image.device
    rows = (torch.arange(height, device=device) + shift[:, :1]).clamp(0, height - 1)
    columns = torch.arange(width, device=device).expand(batch, -1)
    columns = torch.where(mirrored.unsqueeze(1), columns.flip(1), columns)
    columns = (columns + shift[:, 1:]).clamp(0, width - 1)
    # Whole rows first, then columns: two copies that are far cheaper than one that picks pixel by pixel.
    first_row = torch.arange(batch * steps, device=device).view(batch, steps, 1) * height
    moved = image.reshape(-1, width * channels).index_select(0, (first_row + rows.unsqueeze(1)).flatten())
    entries = columns.unsqueeze(2) * channels + torch.arange(channels, device=device)
    entries = entries.view(batch, 1, width * channels).expand(-1, steps * height, -1)
    return moved.view(batch, steps * height, width * channels).gather(2, entries).view(image.shape)


def mirrored_action(action: Tensor, mirrored: Tensor, signs: Sequence[int]) -> Tensor:
    """Give actions, float [B, T, A], their signs [A] in the mirror where `mirrored`, bool [B], says so."""
    sign = torch.tensor(signs, device=action.device, dtype=action.dtype)
    return torch.where(mirrored.view(-1, 1, 1), action * sign, action)


def mirror_image(image: Tensor, action: Tensor, signs: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Return states and candidate actions in the mirror: uint8 [n, H, W, C] and float [n, N, A], as they were given."""
    everything = torch.ones(len(action), dtype=torch.bool, device=action.device)
    return image.flip(2), mirrored_action(action, everything, signs)
