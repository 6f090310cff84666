"""Networks of tests as targets and updates see them, for tests that look at an estimator alone."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from graspq.common.action_space import ActionSpace, grasping
from graspq.train.device import Precision
from graspq.train.networks.network import NetworkSpecification
from graspq.train.state import Networks

ACTION = grasping((0.06, 0.06, 0.06, 0.4))
FLOAT32 = Precision("float32", torch.device("cpu"))


def specification(name: str = "default", size: int = 16, **given: Any) -> NetworkSpecification:
    """Return the specification of a network for square images and actions of four parts."""
    values = {"action": ACTION, "steps": 15, "link": "logistic"} | given
    return NetworkSpecification(name, (size, size, 3), **values)


def plain_networks(
    online: Mapping[str, nn.Module],
    lagged: Mapping[str, nn.Module] | None = None,
    kept: dict[str, Tensor] | None = None,
    action: ActionSpace = ACTION,
) -> Networks:
    """Return networks in float32."""
    return Networks(online, lagged or {}, kept or {}, specification(action=action), FLOAT32)
