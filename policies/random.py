"""The random policy of the paper's code: uniform actions that mostly descend."""

import dataclasses
from typing import Any, ClassVar

import numpy as np

from graspq.common.options import Settings, setting
from graspq.sim.observation import Observation


@dataclasses.dataclass(frozen=True)
class RandomPolicy(Settings):
    """Uniform actions in [-1, 1]^4; with some probability the vertical component is -1.

    Source: Quillen et al. 2018, section VI (the random policy that fills the pool of experience).
    """

    name: ClassVar[str] = "random"

    descend_probability: float = setting(
        0.9, help="probability that an action moves straight down by its limit (dz = -1)", minimum=0.0, maximum=1.0
    )

    @property
    def exploration(self) -> float:
        """Its probability of moving straight down."""
        return self.descend_probability

    def act(self, observation: Observation | None, rng: np.random.Generator) -> np.ndarray:
        """Return a random action, float32 [4]; it looks at nothing."""
        action = rng.uniform(-1.0, 1.0, size=4)
        if rng.random() < self.descend_probability:
            action[2] = -1.0
        return action.astype(np.float32)

    def identity(self) -> dict[str, Any]:
        """Return what tells it from others."""
        return {"random": self.to_json()}
