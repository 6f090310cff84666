"""Pictures of a state that show the same with the same worth of an action: shifted a little, and mirrored.

Training draws them at random (`augment`); a search may ask for the least that Q says of some. Dimensions: B batch,
T steps, V views, N candidates, A action, H W C image.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from graspq.common.action_space import ActionSpace
from graspq.train.networks.network import QNetwork
from graspq.train.selection import QOfActions

# Pixels along rows and columns, and whether mirrored: the picture itself, its mirror image, and four corners around.
VIEWS = ((0, 0, False), (0, 0, True), (2, 2, False), (-2, 2, True), (2, -2, True), (-2, -2, False))


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


def least_of_views(q: QNetwork, space: ActionSpace, image: Tensor, step: Tensor, count: int) -> QOfActions:
    """Return the smallest Q over the first views of one state, as a function of actions, [1, N, A] -> [1, N].

        Q(s, a) = min_v Q_θ(view_v(s), view_v(a))

    A search for the largest Q finds where Q is too large by mistake; such a mistake seldom stands in all views. The
    trunk runs once, on all of them.

    Args:
        q: Q_θ.
        space: says what an action is in the mirror; views of an action space without one are not mirrored.
        image: uint8 [1, H, W, C].
        step: int64 [1].
        count: V, 1 to 6; 1 is Q_θ itself.

    Source: none in Quillen et al. 2018; the smaller of two networks is the target of Fujimoto et al. 2018.
    """
    if count == 1:
        return q.at(image, step)
    # Without a mirror the second is the first once more.
    views = list(dict.fromkeys((*view[:2], view[2] and space.mirror is not None) for view in VIEWS[:count]))
    shift = torch.tensor([view[:2] for view in views], device=image.device)
    mirrored = torch.tensor([view[2] for view in views], device=image.device)
    seen = shifted(image.expand(len(views), -1, -1, -1).unsqueeze(1), shift, mirrored).squeeze(1)
    q_of_views = q.at(seen, step.expand(len(views)))
    signs = space.mirror if space.mirror is not None else (1,) * space.size

    def least(action: Tensor) -> Tensor:
        return q_of_views(mirrored_action(action.expand(len(views), -1, -1), mirrored, signs)).amin(0, keepdim=True)

    return least
