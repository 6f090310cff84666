"""The random policy of the paper's code: uniform actions that mostly descend."""

import dataclasses

import numpy as np

from graspq.common.options import Settings, setting


@dataclasses.dataclass(frozen=True)
class RandomPolicy(Settings):
    """Uniform actions in [-1, 1]^4; with some probability the vertical component is -1.

    Source: Quillen et al. 2018, section VI (the random policy that fills the pool of experience).
    """

    descend_probability: float = setting(
        0.9, help="probability that an action moves straight down by its limit (dz = -1)", minimum=0.0, maximum=1.0
    )

    def act(self, rng: np.random.Generator) -> np.ndarray:
        """Return a random action, float32 [4]."""
        action = rng.uniform(-1.0, 1.0, size=4)
        if rng.random() < self.descend_probability:
            action[2] = -1.0
        return action.astype(np.float32)
