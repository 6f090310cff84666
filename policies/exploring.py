"""Who collects on-policy: at every step either a random action or that of the run's latest policy."""

import dataclasses

import numpy as np

from graspq.sim.observation import Observation
from graspq.sim.play import Policy


@dataclasses.dataclass(frozen=True)
class ExploringPolicy:
    """Tosses a coin at each step.

        a = random action with probability ε, else that of the policy

    Attributes:
        exploration: ε.
        random: draws the random actions.
        greedy: the policy.

    Source: the released code's exploration policy, which Quillen et al. 2018 give no formula for.
    Differs: 1. The policy sees the true step; the released code's counts only the steps at which it was asked, so that
    it sees wrong ones in mixed episodes.
    """

    exploration: float
    random: Policy
    greedy: Policy

    @property
    def name(self) -> str:
        """The greedy policy's, as the episodes table calls it."""
        return self.greedy.name

    def act(self, observation: Observation, rng: np.random.Generator) -> np.ndarray:
        """Return an action, float32 [A] in [-1, 1].

        Args:
            observation: its step counts all actions taken so far, random ones too.
            rng: of the coin, the random action and the policy's search.
        """
        acting = self.random if rng.random() < self.exploration else self.greedy
        return acting.act(observation, rng)
