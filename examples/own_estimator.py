"""An estimator of your own: double Q-learning that distrusts actions the data do not show, with a network of its own.

cd examples && grasp-train --algo own_estimator:conservative --help
cd examples && grasp-train --algo own_estimator:conservative --alpha 0.1 --shards ../data/regular-10k
Its runs are evaluated, swept (`grasp-sweep --algo own_estimator:conservative --vary alpha=0,0.1`) and reported as ours.
"""

import dataclasses
import math

import torch
from torch import Tensor, nn

from graspq.common.options import setting
from graspq.train.acting import StochasticSearch
from graspq.train.batch import Batch
from graspq.train.estimator import Estimator, Metrics, TargetValue, loss_of, targets_of
from graspq.train.estimators import dql
from graspq.train.networks.network import Features, NetworkSpecification, QNetwork
from graspq.train.selection import uniform_actions
from graspq.train.state import TrainState


@dataclasses.dataclass(frozen=True)
class ConservativeSettings(dql.DqlSettings):
    """The options of `dql` and one more: it is checked, stored in config.json, and shown by --help."""

    alpha: float = setting(
        0.05, help="Weight of the penalty on Q of random actions.", minimum=0, source="Kumar et al. 2020, CQL"
    )


class SmallNetwork(QNetwork):
    """Three convolutions and a fully connected layer over the features of the state and the action."""

    def __init__(self, specification: NetworkSpecification) -> None:
        super().__init__()
        height, width, channels = specification.image_shape
        self.convolutions = nn.Sequential(
            nn.Conv2d(channels, 16, 4, 4), nn.ReLU(), nn.Conv2d(16, 32, 3, 2, 1), nn.ReLU(), nn.Flatten()
        )
        size = 32 * math.ceil(height // 4 / 2) * math.ceil(width // 4 / 2)
        self.state = nn.Linear(size + 1, 128)
        self.action = nn.Linear(specification.actions, 128)
        self.last = nn.Linear(128, 1)

    def trunk(self, image: Tensor, step: Tensor) -> Features:
        """Return what depends on the state alone, [B, 128]."""
        seen = self.convolutions(image.permute(0, 3, 1, 2).float() / 255 - 0.5)
        return (self.state(torch.cat([seen, step.unsqueeze(1) / 15], 1)),)

    def head(self, features: Features, action: Tensor) -> Tensor:
        """Return raw outputs for candidate actions [B, N, A]: [B, N]."""
        output: Tensor = self.last((features[0].unsqueeze(1) + self.action(action)).relu()).squeeze(-1)
        return output.float()


def conservative_update(
    row: Estimator[ConservativeSettings],
    state: TrainState,
    batch: Batch,
    settings: ConservativeSettings,
    random: torch.Generator,
    progress: float,
) -> Metrics:
    """Take one step: regression onto the double-Q target, and α (log mean exp output(random) - output(logged))."""
    networks = state.networks
    target = targets_of(row, batch, networks, settings, random, progress)
    networks.q.train()
    metrics = loss_of(row, batch, target, networks, settings)
    logged = batch.real(batch.action)
    drawn = uniform_actions(random, len(logged), settings.candidates, logged.shape[-1]).to(logged.device)
    with networks.autocast():
        features = networks.q.trunk(batch.real(batch.image), batch.real(batch.step))
        output = networks.q.head(features, torch.cat([logged.unsqueeze(1), drawn], 1))
    gap = output[:, 1:].logsumexp(1) - math.log(settings.candidates) - output[:, 0]
    state.descend("q", metrics["loss"] + settings.alpha * gap.mean())
    return {name: value.detach() for name, value in metrics.items()}


conservative: Estimator[ConservativeSettings] = Estimator(
    summary="Double Q-learning with a penalty on Q of random actions",
    settings=ConservativeSettings,
    target_value=TargetValue("bootstrapped (double Q), conservative", dql.target, needs_next=True),
    action_selection=StochasticSearch(),
    paper=ConservativeSettings(loss="squared"),
    parts={"q": SmallNetwork},
    update=conservative_update,
)
