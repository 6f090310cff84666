"""Random changes of a batch that leave the value of its actions as it is: shifts, mirroring, brightness and contrast.

All states of an episode, and s and s' of a transition, are changed alike. Dimensions: B batch, T steps, H W C image.
"""

import dataclasses

import torch
from torch import Tensor

from graspq.train.batch import Batch
from graspq.train.distributed import WHOLE, BatchPart

# (dx, dy, dz, dphi): the mirror image of a motion across the plane y = 0 turns dy and dphi around.
MIRRORED_ACTION = (1.0, -1.0, 1.0, -1.0)


@dataclasses.dataclass(frozen=True)
class Augmentation:
    """Which changes are made.

    Attributes:
        shift: largest shift in pixels, along both axes; the border pixels are repeated.
        mirror: whether half of a batch is mirrored about the plane y = 0, in which the scene is symmetric: its columns
            are reversed and dy and dphi of its actions are negated.
        jitter: largest relative change of contrast, and of brightness in parts of the whole range of grey levels.
        action_noise: standard deviation of normal noise on actions, in units of the action limits. A grasp forgives a
            few millimetres: without the noise Q is jagged in the action, and a search finds its false peaks.
    """

    shift: int
    mirror: bool
    jitter: float
    action_noise: float = 0.0

    def __call__(self, batch: Batch, generator: torch.Generator, part: BatchPart = WHOLE) -> Batch:
        """Return the changed batch.

        Args:
            batch: what the loader gave.
            generator: a CPU generator; how much is drawn depends on the rows of the whole batch alone.
            part: which rows of it these are.
        """
        size, steps, dimensions = batch.action.shape
        low, high = -self.shift, self.shift + 1

        def uniform() -> Tensor:
            return part.draw(size, lambda rows: torch.rand(rows, generator=generator))

        def normal() -> Tensor:
            return part.draw(size, lambda rows: torch.randn(rows, dimensions, generator=generator))

        shifts = part.draw(size, lambda rows: torch.randint(low, high, (rows, 2), generator=generator))
        mirrored = uniform() < (0.5 if self.mirror else 0.0)
        contrast = 1 + self.jitter * (2 * uniform() - 1)
        brightness = 255 * self.jitter * (2 * uniform() - 1)
        # Step by step, and last: episodes are padded to different lengths on different ranks.
        noise = self.action_noise * torch.stack([normal() for _ in range(steps)], 1)
        device = batch.image.device

        def change(image: Tensor) -> Tensor:
            if self.shift or self.mirror:
                image = shifted(image, shifts.to(device), mirrored.to(device))
            return jittered(image, contrast.to(device), brightness.to(device)) if self.jitter else image

        return dataclasses.replace(
            batch,
            image=change(batch.image),
            next_image=None if batch.next_image is None else change(batch.next_image),
            action=mirrored_action((batch.action + noise.to(device)).clamp(-1, 1), mirrored.to(device)),
            synthetic_action=mirrored_action(batch.synthetic_action, mirrored.to(device)),
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


def mirrored_action(action: Tensor, mirrored: Tensor) -> Tensor:
    """Negate dy and dphi of actions, float [B, T, 4], where `mirrored`, bool [B], says so."""
    sign = torch.tensor(MIRRORED_ACTION, device=action.device, dtype=action.dtype)
    return torch.where(mirrored.view(-1, 1, 1), action * sign, action)


def mirror_image(image: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
    """Return states and candidate actions in the mirror: uint8 [n, H, W, C] and float [n, N, A], as they were given."""
    everything = torch.ones(len(action), dtype=torch.bool, device=action.device)
    return image.flip(2), mirrored_action(action, everything)


def jittered(image: Tensor, contrast: Tensor, brightness: Tensor) -> Tensor:
    """Return clamp(contrast · (image - 128) + 128 + brightness, 0, 255), for uint8 [B, T, H, W, C] and float [B]."""
    shape = (-1, 1, 1, 1, 1)
    changed = (image.float() - 128) * contrast.view(shape) + (128 + brightness).view(shape)
    return changed.round_().clamp_(0, 255).to(torch.uint8)
