"""The default network: a small residual trunk, and an action that enters late and linearly.

Whatever depends on the image alone is computed once for a state; sixteen candidate actions cost little more than one.
Dimensions: B batch, N candidates, A action, H W C image.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from graspq.common.errors import UserError
from graspq.train.networks import Features, NetworkSpecification, QNetwork

CHANNELS = 64
STATE = 256
HIDDEN = 128
STEM = 16
SQUEEZED = 32


def _normalised(inputs: int, outputs: int, size: int, stride: int = 1) -> nn.Sequential:
    convolution = nn.Conv2d(inputs, outputs, size, stride, (size - 1) // 2, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs))


class _Residual(nn.Module):
    """relu(x + norm(convolution 3×3 (x)))."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.branch = _normalised(channels, channels, 3)

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(self.branch(x).add_(x), inplace=True)


class DefaultNetwork(QNetwork):
    """Residual trunk at 32, 16 and 8 pixels (for 64×64 images) and an action that enters late, linearly.

    The trunk gives a vector z of the whole state, and

        Q(s, a) = MLP(relu(U z + W a))

    Batch normalisation uses running statistics in evaluation mode, which every pass but the regression's own uses.
    A head in which each candidate attended to the trunk's map was tried: on 10,000 grasps its held-back loss was higher
    at equal steps (0.512 against 0.508 after 800), and it cost more.

    Source: none; the paper's network is `PaperNetwork`.
    """

    def __init__(self, specification: NetworkSpecification) -> None:
        super().__init__()
        height, width, channels = specification.image_shape
        if height % 8 or width % 8 or min(height, width) < 16:
            raise UserError(f"images of {specification.image_shape}: expected sides that 8 divides, of at least 16")
        self.stem = _normalised(channels, STEM, 3, 2)
        self.reduce = _normalised(STEM, CHANNELS, 3, 2)
        self.fine = _Residual(CHANNELS)
        self.coarse = nn.Sequential(_Residual(CHANNELS), _Residual(CHANNELS))
        self.squeeze = _normalised(CHANNELS, SQUEEZED, 1)
        self.state = nn.Linear(SQUEEZED * (height // 8) * (width // 8), STATE)
        self.step = nn.Embedding(specification.steps, STATE)
        # Steps that the data hardly reach must not carry noise.
        nn.init.zeros_(self.step.weight)
        self.state_to_hidden = nn.Linear(STATE, STATE)
        self.action_to_hidden = nn.Linear(specification.actions, STATE, bias=False)
        self.hidden = nn.Linear(STATE, HIDDEN)
        self.last = nn.Linear(HIDDEN, 1)

    def trunk(self, image: Tensor, step: Tensor) -> Features:
        """Return U z + bias [B, 256]; see `QNetwork.trunk`."""
        # Exact in bfloat16 too: whole numbers below 2⁸, then a power of two.
        x = image.permute(0, 3, 1, 2).to(_computing_type(image.device.type)).sub_(128).mul_(1 / 64)
        x = functional.relu(self.stem(x), inplace=True)
        fine = self.fine(functional.relu(self.reduce(x), inplace=True))
        # A step of training is 9 % cheaper with averaging than with a convolution of stride 2 here.
        coarse = self.coarse(functional.avg_pool2d(fine, 2))
        flat = functional.relu(self.squeeze(coarse), inplace=True).flatten(1)
        known_step = step.clamp(0, self.step.num_embeddings - 1)
        z = functional.relu(self.state(flat) + self.step(known_step))
        return (self.state_to_hidden(z),)

    def head(self, features: Features, action: Tensor) -> Tensor:
        """Return raw outputs [B, N]; see `QNetwork.head`."""
        hidden = features[0].unsqueeze(1) + self.action_to_hidden(action)
        hidden = functional.relu(self.hidden(functional.relu(hidden)))
        # The last sum in float32: Q must tell candidates apart more finely than bfloat16's 8 bits.
        output: Tensor = (hidden.float() * self.last.weight[0]).sum(-1) + self.last.bias
        return output


def _computing_type(device: str) -> torch.dtype:
    return torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else torch.float32
