"""The network of the paper's released code: three convolutions, layer normalisation, about 73k weights.

It gives the same Q as the released graph but computes the image's part of the first fully connected layer once a state.
"""

import dataclasses

import torch
from torch import Tensor, nn
from torch.nn import functional

from graspq.common.errors import UserError
from graspq.common.options import setting
from graspq.train.networks.network import (
    Features,
    NetworkFamily,
    NetworkSettings,
    NetworkSpecification,
    QNetwork,
    StateNetwork,
)

INITIAL_DEVIATION = 0.01
EPSILON = 1e-12


@dataclasses.dataclass(frozen=True)
class PaperNetworkSettings(NetworkSettings):
    """Options of the paper's network."""

    width: int = setting(32, help="Channels and units.", minimum=1, maximum=10_000)


def _units(specification: NetworkSpecification) -> int:
    return PaperNetworkSettings.from_json(specification.settings).width


class _LayerNorm(nn.Module):
    """Layer normalisation over all but the batch's dimensions, with one gain and bias a channel, then ReLU.

    Acts on [B, C, H, W] (statistics over C, H and W) and on [..., C] (over C).
    """

    def __init__(self, channels: int, *, spatial: bool) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))
        self.spatial = spatial

    def forward(self, x: Tensor) -> Tensor:
        if self.spatial:
            # One group of all channels is this very function, and four times as fast as writing it out.
            normal = functional.group_norm(x.float(), 1, self.gain, self.bias, EPSILON)
        else:
            normal = functional.layer_norm(x.float(), self.gain.shape, self.gain, self.bias, EPSILON)
        return functional.relu(normal)


class _StateMap(nn.Module):
    """Three 3×3 convolutions of stride 2, no padding, on the raw 0..255 image; the raw step tiled as one channel more.

    [B, H, W, C] uint8 and [B] int64 -> float32 [B, width + 1, H', W'].
    """

    def __init__(self, specification: NetworkSpecification) -> None:
        super().__init__()
        height, width, channels = specification.image_shape
        for _ in range(3):
            height, width = (height - 1) // 2, (width - 1) // 2
        if min(height, width) < 1:
            raise UserError(f"images of {specification.image_shape}: the paper's network needs at least 15 x 15 pixels")
        units = _units(specification)
        self.convolutions = nn.ModuleList(
            nn.Conv2d(inputs, units, 3, stride=2, bias=False) for inputs in (channels, units, units)
        )
        self.norms = nn.ModuleList(_LayerNorm(units, spatial=True) for _ in range(3))
        self.pixels = height * width

    def forward(self, image: Tensor, step: Tensor) -> Tensor:
        x = image.permute(0, 3, 1, 2).float()
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            x = norm(convolution(x))
        tiled = step.to(x.dtype).view(-1, 1, 1, 1).expand(-1, 1, *x.shape[2:])
        return torch.cat([x, tiled], dim=1)


class PaperNetwork(QNetwork):
    """`cnn_ia_v1` of the released code.

    `_StateMap` of 32 channels (`--width`); the action through a fully connected layer of 33, added at every position;
    then fully connected layers of 32, 32 and 1. Every layer but the last is normalised (`_LayerNorm`) and has no bias
    of its own. All weights start from a normal distribution with deviation 0.01, truncated at two deviations.

    FC₁(M + tile(e)) = FC₁(M) + (Σₚ W₁ₚ) e splits the first layer after the action: FC₁(M) is the trunk's, and a
    candidate costs 2.2k multiplications rather than 53k.

    Source: the paper's figure 3; released code, `tf_critics.py` and `tf_modules.py`.
    Differs: images of any size from 15×15 (the released code's were 64×64 and so are ours).
    """

    def __init__(self, specification: NetworkSpecification) -> None:
        super().__init__()
        self.map = _StateMap(specification)
        units = _units(specification)
        self.action = nn.Linear(specification.actions, units + 1, bias=False)
        self.action_norm = _LayerNorm(units + 1, spatial=False)
        self.first = nn.Linear((units + 1) * self.map.pixels, units, bias=False)
        self.first_norm = _LayerNorm(units, spatial=False)
        self.second = nn.Linear(units, units, bias=False)
        self.second_norm = _LayerNorm(units, spatial=False)
        self.last = nn.Linear(units, 1)
        _initialise(self)

    def trunk(self, image: Tensor, step: Tensor) -> Features:
        """Return FC₁(M), float [B, 32]; see `QNetwork.trunk`."""
        return (self.first(self.map(image, step).flatten(1)),)

    def head(self, features: Features, action: Tensor) -> Tensor:
        """Return raw outputs [B, N]; see `QNetwork.head`."""
        embedding = self.action_norm(self.action(action))
        summed = self.first.weight.view(len(self.first.weight), embedding.shape[-1], -1).sum(2)
        hidden = self.first_norm(features[0].unsqueeze(1) + functional.linear(embedding, summed))
        hidden = self.second_norm(self.second(hidden))
        # The last sum in float32: Q must tell candidates apart more finely than bfloat16's 8 bits.
        output: Tensor = (hidden.float() * self.last.weight[0]).sum(-1) + self.last.bias
        return output


class PaperStateNetwork(StateNetwork):
    """The same network without the action, as the released code's actor.

    Source: released code, `tf_critics.py`; see `PaperNetwork`.
    """

    def __init__(self, specification: NetworkSpecification, outputs: int) -> None:
        super().__init__()
        self.map = _StateMap(specification)
        units = _units(specification)
        self.first = nn.Linear((units + 1) * self.map.pixels, units, bias=False)
        self.first_norm = _LayerNorm(units, spatial=False)
        self.second = nn.Linear(units, units, bias=False)
        self.second_norm = _LayerNorm(units, spatial=False)
        self.last = nn.Linear(units, outputs)
        _initialise(self)

    def forward(self, image: Tensor, step: Tensor) -> Tensor:
        """Return raw outputs, float32 [B, outputs]; see `StateNetwork.forward`."""
        hidden = self.first_norm(self.first(self.map(image, step).flatten(1)))
        output: Tensor = self.last(self.second_norm(self.second(hidden)))
        return output.float()


def _initialise(network: nn.Module) -> None:
    for module in network.modules():
        if isinstance(module, nn.Conv2d | nn.Linear):
            bound = 2 * INITIAL_DEVIATION
            nn.init.trunc_normal_(module.weight, std=INITIAL_DEVIATION, a=-bound, b=bound)
            if module.bias is not None:
                nn.init.zeros_(module.bias)


network = NetworkFamily(PaperNetwork, PaperStateNetwork, PaperNetworkSettings)
