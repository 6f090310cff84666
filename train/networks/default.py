"""The default network: it looks where an action leads. A small residual trunk, points found in the picture, and late,
linear action.

Whatever depends on the image alone is computed once for a state; sixteen candidate actions cost little more than one.
Dimensions: B batch, N candidates, A action, K points, M channels of the map, H W C image.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from graspq.common.errors import UserError
from graspq.train.networks.network import Features, NetworkFamily, NetworkSpecification, QNetwork, StateNetwork

CHANNELS = 64
STATE = 256
HIDDEN = 128
STEM = 16
SQUEEZED = 32
KEYPOINTS = 16
LOOKS = 4
MAP = 32
# Points may lie a little outside the picture, whose border is repeated there.
FARTHEST = 1.1


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


class _Keypoints(nn.Module):
    """Spatial softmax: the expected position of each of K heat maps; [B, C, H, W] -> float32 [B, 2 K] in [-1, 1].

        pₖ = Σᵤ softmax(heatₖ)(u) u,  u = (x, y) over the picture

    Source: Levine et al. 2016, "End-to-End Training of Deep Visuomotor Policies", section 5.1.
    """

    def __init__(self, channels: int, points: int, height: int, width: int) -> None:
        super().__init__()
        self.heat = nn.Conv2d(channels, points, 1)
        rows, columns = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
        self.register_buffer("position", torch.stack([columns.flatten(), rows.flatten()], 1), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        position: Tensor = self.position  # type: ignore[assignment]
        share = self.heat(x).float().flatten(2).softmax(-1)
        with _float32(x):
            points: Tensor = (share @ position).flatten(1)
            return points


class StateEncoder(nn.Module):
    """What the default networks know of a state: a vector, K points found in the picture, and a map of local features.

    A residual trunk at 32, 16 and 8 pixels (for 64×64 images). The step enters as the number step / T: data of a random
    policy hardly reach late steps, and a weight of their own there would stay what it was at the start; a bootstrapped
    Q then trusts late states that it never saw, and its policy waits for them.

    Source: none; the paper's network is `PaperNetwork`.
    """

    def __init__(self, specification: NetworkSpecification) -> None:
        super().__init__()
        height, width, channels = specification.image_shape
        if height % 8 or width % 8 or min(height, width) < 16:
            raise UserError(f"images of {specification.image_shape}: expected sides that 8 divides, of at least 16")
        self.last_step = max(specification.steps - 1, 1)
        self.stem = _normalised(channels, STEM, 3, 2)
        self.reduce = _normalised(STEM, CHANNELS, 3, 2)
        self.fine = _Residual(CHANNELS)
        self.coarse = nn.Sequential(_Residual(CHANNELS), _Residual(CHANNELS))
        self.squeeze = _normalised(CHANNELS, SQUEEZED, 1)
        self.keypoints = _Keypoints(CHANNELS, KEYPOINTS, height // 4, width // 4)
        self.state = nn.Linear(SQUEEZED * (height // 8) * (width // 8), STATE)
        self.points_to_state = nn.Linear(2 * KEYPOINTS, STATE, bias=False)
        self.step_to_state = nn.Linear(1, STATE, bias=False)
        nn.init.zeros_(self.step_to_state.weight)

    def forward(self, image: Tensor, step: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the state's vector [B, 256], points float32 [B, 2 K], and the maps at 16 and 8 pixels [B, 64, H', W'].

        Args:
            image: uint8 [B, H, W, C].
            step: int64 [B].
        """
        # Exact in bfloat16 too: whole numbers below 2⁸, then a power of two.
        x = image.permute(0, 3, 1, 2).to(_computing_type(image.device.type)).sub_(128).mul_(1 / 64)
        x = functional.relu(self.stem(x), inplace=True)
        fine = self.fine(functional.relu(self.reduce(x), inplace=True))
        # A step of training is 9 % cheaper with averaging than with a convolution of stride 2 here.
        coarse = self.coarse(functional.avg_pool2d(fine, 2))
        points = self.keypoints(fine)
        flat = functional.relu(self.squeeze(coarse), inplace=True).flatten(1)
        done = step.clamp(0, self.last_step).unsqueeze(1) / self.last_step
        vector = self.state(flat) + self.points_to_state(points) + self.step_to_state(done)
        return functional.relu(vector), points, fine, coarse


class DefaultNetwork(QNetwork):
    """A Q-function that looks at the picture where the action leads.

    The encoder gives a vector z of the state, points p in the picture and, from its maps, a map F of local features:

        uₖ = pₖ + Dₖ a              where to look, k = 1 .. 4: a learned combination of points, moved by the action
        fₖ = F(uₖ)                  bilinear
        Q(s, a) = MLP(relu(U z + W a + Σₖ Vₖ fₖ))

    Whether a grasp holds depends on what lies between the fingers when they close. A network that must carry that place
    in a single vector has to learn it anew for every place; this one moves its look with the action. Measured on 10,000
    grasps with `mc`, all else equal: ROC AUC at held-back last steps 0.90 against 0.81.
    Batch normalisation uses running statistics in evaluation mode, which every pass but the regression's own uses.

    Source: none; the paper's network is `PaperNetwork`. Spatial softmax: see `_Keypoints`. Bilinear looks: Jaderberg et
    al. 2015, "Spatial Transformer Networks".
    """

    def __init__(self, specification: NetworkSpecification) -> None:
        super().__init__()
        self.encoder = StateEncoder(specification)
        self.map_fine = nn.Conv2d(CHANNELS, MAP, 1)
        self.map_coarse = nn.Conv2d(CHANNELS, MAP, 1)
        self.where = nn.Linear(2 * KEYPOINTS, 2 * LOOKS)
        self.displacement = nn.Linear(specification.actions, 2 * LOOKS, bias=False)
        self.looks_to_hidden = nn.Linear(LOOKS * MAP, STATE, bias=False)
        self.state_to_hidden = nn.Linear(STATE, STATE)
        self.action_to_hidden = nn.Linear(specification.actions, STATE, bias=False)
        self.hidden = nn.Linear(STATE, HIDDEN)
        self.last = nn.Linear(HIDDEN, 1)
        # At first each look follows one point, near it.
        with torch.no_grad():
            self.where.weight.copy_(torch.eye(2 * LOOKS, 2 * KEYPOINTS))
            self.where.bias.normal_(std=0.1)
            self.displacement.weight.normal_(std=0.1)

    def trunk(self, image: Tensor, step: Tensor) -> Features:
        """Return U z [B, 256], p [B, 2 K] and F [B, M, H/4, W/4]; see `QNetwork.trunk`."""
        vector, points, fine, coarse = self.encoder(image, step)
        finer = functional.interpolate(self.map_coarse(coarse), scale_factor=2.0, mode="nearest")
        local = functional.relu(self.map_fine(fine) + finer)
        with _float32(points):
            where = self.where(points)
        return self.state_to_hidden(vector), where, local

    def head(self, features: Features, action: Tensor) -> Tensor:
        """Return raw outputs [B, N]; see `QNetwork.head`."""
        state, where, local = features
        # In float32: bfloat16 would place a look no better than to a twentieth of a pixel of the map.
        with _float32(where):
            places = where.unsqueeze(1) + self.displacement(action.float())
            # Where training diverged: the gradient of grid_sample would write outside its memory at NaN.
            places = places.nan_to_num(nan=0.0).clamp(-FARTHEST, FARTHEST).unflatten(-1, (LOOKS, 2))
            looks = functional.grid_sample(local.float(), places, padding_mode="border", align_corners=True)
        seen = self.looks_to_hidden(looks.permute(0, 2, 3, 1).flatten(2))
        hidden = state.unsqueeze(1) + self.action_to_hidden(action) + seen
        hidden = functional.relu(self.hidden(functional.relu(hidden)))
        # The last sum in float32: Q must tell candidates apart more finely than bfloat16's 8 bits.
        output: Tensor = (hidden.float() * self.last.weight[0]).sum(-1) + self.last.bias
        return output


class DefaultStateNetwork(StateNetwork):
    """The default network without an action: MLP(z) of the encoder's vector z, for actors and V(s)."""

    def __init__(self, specification: NetworkSpecification, outputs: int) -> None:
        super().__init__()
        self.encoder = StateEncoder(specification)
        self.hidden = nn.Linear(STATE, HIDDEN)
        self.last = nn.Linear(HIDDEN, outputs)

    def forward(self, image: Tensor, step: Tensor) -> Tensor:
        """Return raw outputs, float32 [B, outputs]; see `StateNetwork.forward`."""
        hidden = functional.relu(self.hidden(self.encoder(image, step)[0]))
        with _float32(hidden):
            output: Tensor = self.last(hidden.float())
            return output


def _float32(near: Tensor) -> torch.autocast:
    """Return the context in which all is computed in float32."""
    return torch.autocast(near.device.type, enabled=False)


def _computing_type(device: str) -> torch.dtype:
    return torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else torch.float32


network = NetworkFamily(DefaultNetwork, DefaultStateNetwork)
