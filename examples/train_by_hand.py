"""Monte-Carlo regression on logged grasps in plain PyTorch: `python examples/train_by_hand.py data/regular-10k 500`."""

import itertools
import sys

import torch
from torch import Tensor, nn

import graspq


class QNetwork(nn.Module):
    """Q of a state, image and step, and an action."""

    def __init__(self) -> None:
        super().__init__()
        first, second = nn.Conv2d(3, 32, kernel_size=5, stride=4, padding=2), nn.Conv2d(32, 64, 3, stride=2, padding=1)
        self.image = nn.Sequential(first, nn.ReLU(), second, nn.ReLU(), nn.Flatten())
        self.value = nn.Sequential(nn.LazyLinear(128), nn.ReLU(), nn.Linear(128, 1))

    def forward(self, image: Tensor, step: Tensor, action: Tensor) -> Tensor:
        """Return Q, float32 [B], of images uint8 [B, H, W, 3], steps int64 [B] and actions float32 [B, A]."""
        seen = self.image(image.permute(0, 3, 1, 2) / 255)
        q: Tensor = self.value(torch.cat([seen, step[:, None], action], 1))
        return q.squeeze(1)


def squared_error(batch: dict[str, Tensor]) -> Tensor:
    """Return the mean of (Q(s, a) − R)² over a batch."""
    q = network(batch["image"], batch["step"], batch["action"])
    return nn.functional.mse_loss(q, batch["mc_return"])


training, held_back = graspq.open(sys.argv[1]).split(0.1, seed=0)
network = QNetwork()
optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
with training.batches(batch_size=64, seed=0, need_next=False) as batches:
    for number, batch in enumerate(itertools.islice(batches, int(sys.argv[2]))):
        loss = squared_error(batch.tensors())
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        if number % 50 == 0:
            print(f"step {number}: squared error {loss.item():.4f}")
with torch.no_grad():
    losses = [squared_error(batch.tensors()).item() for batch in held_back.once(batch_size=256)]
print(f"held back: squared error {sum(losses) / len(losses):.4f}")
