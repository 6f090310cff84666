"""The default network and its training step as one writes them plainly in PyTorch: the rival of `training.py`.

float32, images in NCHW, no fused optimiser, one image after the other in augmentation. `training.py` checks at each run
that it computes what `graspq.train` computes. Dimensions: B batch, N candidates, A action, H W C image.
"""

import copy
import random
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from graspq.train.estimators.dql import DqlSettings
from graspq.train.networks.network import QNetwork
from graspq.train.settings import TrainSettings


def conv_norm(inputs: int, outputs: int, size: int, stride: int = 1) -> nn.Sequential:
    """Return a convolution without bias, then batch normalisation."""
    conv = nn.Conv2d(inputs, outputs, size, stride=stride, padding=size // 2, bias=False)
    return nn.Sequential(conv, nn.BatchNorm2d(outputs))


class PlainNetwork(nn.Module):
    """The default network for one action a picture; see `train/networks/default.py` for what it is."""

    def __init__(self, last_step: int, actions: int = 4) -> None:
        super().__init__()
        self.last_step = last_step
        self.stem = conv_norm(3, 16, 3, stride=2)
        self.reduce = conv_norm(16, 64, 3, stride=2)
        self.fine = conv_norm(64, 64, 3)
        self.coarse1 = conv_norm(64, 64, 3)
        self.coarse2 = conv_norm(64, 64, 3)
        self.squeeze = conv_norm(64, 32, 1)
        self.heat = nn.Conv2d(64, 16, 1)
        self.state = nn.Linear(32 * 8 * 8, 256)
        self.points_to_state = nn.Linear(32, 256, bias=False)
        self.step_to_state = nn.Linear(1, 256, bias=False)
        self.map_fine = nn.Conv2d(64, 32, 1)
        self.map_coarse = nn.Conv2d(64, 32, 1)
        self.where = nn.Linear(32, 8)
        self.displacement = nn.Linear(actions, 8, bias=False)
        self.looks_to_hidden = nn.Linear(4 * 32, 256, bias=False)
        self.state_to_hidden = nn.Linear(256, 256)
        self.action_to_hidden = nn.Linear(actions, 256, bias=False)
        self.hidden = nn.Linear(256, 128)
        self.last = nn.Linear(128, 1)

    def forward(self, image: Tensor, step: Tensor, action: Tensor) -> Tensor:
        """Return Q before its logistic function, float32 [B].

        `image` is float32 [B, C, H, W], 0 to 255; `step` int64 [B]; `action` float32 [B, A].
        """
        return self.of_actions(self.trunk(image, step), action.unsqueeze(1)).squeeze(1)

    def trunk(self, image: Tensor, step: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what no action changes: state [B, 256], key points [B, 32], local map [B, 32, 16, 16]."""
        x = (image - 128) / 64
        x = F.relu(self.stem(x))
        x = F.relu(self.reduce(x))
        fine = F.relu(x + self.fine(x))
        x = F.avg_pool2d(fine, 2)
        x = F.relu(x + self.coarse1(x))
        coarse = F.relu(x + self.coarse2(x))
        points = self.keypoints(fine)
        done = (step.clamp(0, self.last_step).float() / self.last_step).unsqueeze(1)
        flat = F.relu(self.squeeze(coarse)).flatten(1)
        state = F.relu(self.state(flat) + self.points_to_state(points) + self.step_to_state(done))
        local = F.relu(self.map_fine(fine) + F.interpolate(self.map_coarse(coarse), scale_factor=2, mode="nearest"))
        return state, points, local

    def of_actions(self, trunk: tuple[Tensor, Tensor, Tensor], action: Tensor) -> Tensor:
        """Return Q before its logistic function of the actions [B, N, A]; float32 [B, N]."""
        state, points, local = trunk
        rows, count = action.shape[:2]
        places = (self.where(points).unsqueeze(1) + self.displacement(action)).clamp(-1.1, 1.1)
        places = places.view(rows, count, 4, 2)
        looks = F.grid_sample(local, places, padding_mode="border", align_corners=True)  # [B, 32, N, 4]
        looks = looks.permute(0, 2, 3, 1).flatten(2)
        state = self.state_to_hidden(state).unsqueeze(1)
        hidden = F.relu(state + self.action_to_hidden(action) + self.looks_to_hidden(looks))
        output: Tensor = self.last(F.relu(self.hidden(hidden)))
        return output.squeeze(2)

    def keypoints(self, x: Tensor) -> Tensor:
        """Return the expected place, x then y in [-1, 1], of each of 16 heat maps; float32 [B, 32]."""
        heat = self.heat(x)
        height, width = heat.shape[2:]
        share = F.softmax(heat.flatten(2), dim=-1).view_as(heat)
        across = (share.sum(2) * torch.linspace(-1, 1, width)).sum(-1)
        down = (share.sum(3) * torch.linspace(-1, 1, height)).sum(-1)
        return torch.stack([across, down], -1).flatten(1)


# Names of our network's parts -> names of the same parts here, where they differ.
RENAMED = {
    "encoder.fine.branch": "fine",
    "encoder.coarse.0.branch": "coarse1",
    "encoder.coarse.1.branch": "coarse2",
    "encoder.keypoints.heat": "heat",
    "encoder.": "",
}


def plain_copy(network: QNetwork, last_step: int) -> PlainNetwork:
    """Return a plain network with the weights of ours, contiguous in memory."""
    plain, state = PlainNetwork(last_step), {}
    for name, tensor in network.state_dict().items():
        old = next((old for old in RENAMED if name.startswith(old)), "")
        state[RENAMED.get(old, "") + name.removeprefix(old)] = tensor.detach().clone().contiguous()
    plain.load_state_dict(state)
    return plain


def augmented(
    image: Tensor, action: Tensor, shifts: Sequence[Sequence[int]], mirrored: Sequence[bool], margin: int
) -> tuple[Tensor, Tensor]:
    """Return pictures padded with their border, cropped and mirrored one by one, and their actions.

    `image` is uint8 [B, C, H, W]; `shifts` are rows and columns that each is moved by, from -`margin` to `margin`.
    """
    height, width = image.shape[2:]
    images, actions = [], []
    for picture, motion, (down, across), mirror in zip(image, action, shifts, mirrored, strict=True):
        padded = F.pad(picture.float().unsqueeze(0), (margin,) * 4, mode="replicate").squeeze(0)
        picture = padded[:, margin + down : margin + down + height, margin + across : margin + across + width]
        if mirror:
            picture = torch.flip(picture, dims=[2])
            motion = motion * torch.tensor([1.0, -1.0, 1.0, -1.0])
        images.append(picture)
        actions.append(motion)
    return torch.stack(images), torch.stack(actions)


class PlainTraining:
    """Plain training of `mc`, or of `dql`, whose candidates share their picture's part of Q or have a copy each.

    A batch is a dictionary: `image` uint8 [B, C, H, W], `step` int64 [B], `action` float32 [B, A], `mc_return`,
    `reward` float32 [B], `terminal` bool [B], and for `dql` `next_image` and `next_step`.
    """

    def __init__(self, network: PlainNetwork, settings: TrainSettings, tiled: bool = False) -> None:
        """Start with these weights; `tiled` gives every candidate a copy of its picture."""
        self.network, self.settings, self.tiled = network, settings, tiled
        self.dql = settings.own if isinstance(settings.own, DqlSettings) else None
        self.average = copy.deepcopy(network).eval()
        self.lagged = copy.deepcopy(network).eval()
        matrices = [parameter for parameter in network.parameters() if parameter.dim() > 1]
        others = [parameter for parameter in network.parameters() if parameter.dim() <= 1]
        groups = [{"params": matrices, "weight_decay": settings.weight_decay}, {"params": others, "weight_decay": 0.0}]
        self.optimizer = torch.optim.AdamW(groups, lr=settings.learning_rate, foreach=False, fused=False)
        self.step = 0

    def update(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Take one gradient step; return the loss."""
        margin, rows = self.settings.shift, len(batch["action"])
        shifts = [[random.randint(-margin, margin), random.randint(-margin, margin)] for _ in range(rows)]
        mirrored = [random.random() < 0.5 for _ in range(rows)]
        image, action = augmented(batch["image"], batch["action"], shifts, mirrored, margin)
        target = batch["mc_return"]
        if self.dql is not None:
            next_image, _ = augmented(batch["next_image"], batch["action"], shifts, mirrored, margin)
            candidates = torch.rand(rows, self.dql.candidates, action.shape[1]) * 2 - 1
            target = self.double_q(batch, next_image, candidates, self.dql.discount)
        self.network.train()
        loss = F.binary_cross_entropy_with_logits(self.network(image, batch["step"], action), target)
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        self.follow()
        return {"loss": loss}

    @torch.no_grad()
    def double_q(self, batch: dict[str, Tensor], next_image: Tensor, candidates: Tensor, discount: float) -> Tensor:
        """Return r + γ Q'(s', argmax Q(s', aᵢ)) of N candidates, float32 [B, N, A]; `next_image` float32."""
        self.network.eval()
        rows, count, dimensions = candidates.shape
        if self.tiled:
            copies, steps = (x.repeat_interleave(count, 0) for x in (next_image, batch["next_step"]))
            q = self.network(copies, steps, candidates.view(-1, dimensions)).view(rows, count)
        else:
            q = self.network.of_actions(self.network.trunk(next_image, batch["next_step"]), candidates)
        best = candidates[torch.arange(rows), q.argmax(1)]
        value = torch.sigmoid(self.lagged(next_image, batch["next_step"], best))
        return batch["reward"] + discount * value * (~batch["terminal"]).float()

    @torch.no_grad()
    def follow(self) -> None:
        """Let the averaged and the lagged network follow."""
        self.step += 1
        decay = min(self.settings.average_decay, (1 + self.step) / (10 + self.step))
        learned = self.network.state_dict()
        for name, mean in self.average.state_dict().items():
            if mean.is_floating_point():
                mean.mul_(decay).add_(learned[name] * (1 - decay))
            else:
                mean.copy_(learned[name])
        if self.dql is not None and self.step % self.dql.lag_steps == 0:
            self.lagged.load_state_dict(learned)
