"""The default network: a small residual trunk, and a head in which each candidate action looks at a place of the image.

An action's outcome is decided where the gripper will land, so the head lets the action attend to the trunk's map there
instead of squeezing the scene through one vector. Dimensions: B batch, N candidates, A action, P positions of the map.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from graspq.common.errors import UserError
from graspq.train.networks import Features, NetworkSpecification, QNetwork

CHANNELS = 64
HEADS = 4
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

    The trunk gives a vector z of the whole state and a map M with a row mₚ for each of P = 16·16 positions. With
    attention, an action a reads the map through 4 heads: its query is linear in a and in z, and is compared with mₚ
    and with fixed functions f of the position p (x, y, x², y², xy, sines and cosines), so that it can mean "near here":

        q(a)  = W_q a + U_q z                                  4 heads of 64 + 17 numbers
        c(a)  = Σₚ softmaxₚ(⟨q(a), (mₚ, f(p))⟩ / 8) mₚ          4 heads of 64 numbers
        Q(s, a) = MLP(relu(U z + W a + O c(a)))

    Keys and values are the map itself: a query that is linear in the action makes a further key layer needless, and the
    trunk's cost does not grow. Batch normalisation uses running statistics in evaluation mode, which every pass but the
    regression's own uses.

    Source: none; the paper's network is `PaperNetwork`.
    """

    positions: Tensor

    def __init__(self, specification: NetworkSpecification, *, attention: bool = True) -> None:
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
        self.attention = attention
        if attention:
            positions = _position_features(height // 4, width // 4)
            self.register_buffer("positions", positions, persistent=False)
            query = HEADS * (CHANNELS + positions.shape[0])
            self.state_to_query = nn.Linear(STATE, query)
            self.action_to_query = nn.Linear(specification.actions, query, bias=False)
            self.attended_to_hidden = nn.Linear(HEADS * CHANNELS, STATE, bias=False)

    def trunk(self, image: Tensor, step: Tensor) -> Features:
        """Return U z + bias [B, 256] and, with attention, U_q z + bias [B, 324] and the map M [B, P, 64]."""
        # Exact in bfloat16 too: whole numbers below 2⁸, then a power of two.
        x = image.permute(0, 3, 1, 2).to(_computing_type(image.device.type)).sub_(128).mul_(1 / 64)
        x = functional.relu(self.stem(x), inplace=True)
        fine = self.fine(functional.relu(self.reduce(x), inplace=True))
        # A step of training is 9 % cheaper with averaging than with a convolution of stride 2 here.
        coarse = self.coarse(functional.avg_pool2d(fine, 2))
        flat = functional.relu(self.squeeze(coarse), inplace=True).flatten(1)
        known_step = step.clamp(0, self.step.num_embeddings - 1)
        z = functional.relu(self.state(flat) + self.step(known_step))
        if not self.attention:
            return (self.state_to_hidden(z),)
        return self.state_to_hidden(z), self.state_to_query(z), fine.flatten(2).transpose(1, 2)

    def head(self, features: Features, action: Tensor) -> Tensor:
        """Return raw outputs [B, N]; see `QNetwork.head`."""
        hidden = features[0].unsqueeze(1) + self.action_to_hidden(action)
        if self.attention:
            query = features[1].unsqueeze(1) + self.action_to_query(action)
            attended = self._attend(query.view(len(query), query.shape[1] * HEADS, -1), features[2])
            hidden = hidden + self.attended_to_hidden(attended.view(*action.shape[:2], -1))
        hidden = functional.relu(self.hidden(functional.relu(hidden)))
        # The last sum in float32: Q must tell candidates apart more finely than bfloat16's 8 bits.
        output: Tensor = (hidden.float() * self.last.weight[0]).sum(-1) + self.last.bias
        return output

    def _attend(self, query: Tensor, values: Tensor) -> Tensor:
        """Return Σₚ softmaxₚ(score) mₚ, [B, N·heads, 64], for queries [B, N·heads, 64 + 17] and the map [B, P, 64]."""
        content, place = query[..., :CHANNELS], query[..., CHANNELS:]
        scores = torch.bmm(content, values.transpose(1, 2)) + place @ self.positions
        weights = (scores.float() / math.sqrt(CHANNELS)).softmax(-1)
        return torch.bmm(weights.to(values.dtype), values)


def _computing_type(device: str) -> torch.dtype:
    return torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else torch.float32


def _position_features(height: int, width: int) -> Tensor:
    """Return x, y, x², y², xy and sines and cosines of each position of a map, x and y in [-1, 1]; float32 [17, P]."""
    rows = (torch.arange(height) + 0.5) / height * 2 - 1
    columns = (torch.arange(width) + 0.5) / width * 2 - 1
    y, x = (grid.flatten() for grid in torch.meshgrid(rows, columns, indexing="ij"))
    waves = [wave(math.pi * k * c) for k in (1, 2, 4) for c in (x, y) for wave in (torch.sin, torch.cos)]
    return torch.stack([x, y, x * x, y * y, x * y, *waves])
