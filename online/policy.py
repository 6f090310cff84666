"""Who collects on-policy: at every step either a random action or that of the run's latest policy.

Dimension key: H W C image.
"""

import dataclasses
from pathlib import Path

import numpy as np

from graspq.evaluate.policies import Policy
from graspq.evaluate.settings import CemSettings
from graspq.policies.random import RandomPolicy
from graspq.sim.observation import Observation


@dataclasses.dataclass(frozen=True)
class ExploringPolicy:
    """A policy that tosses a coin at each step.

        a = random action with probability ε, else that of the policy

    Attributes:
        name: `ALGO@STEP`, as the episodes table calls it.
        exploration: ε.
        random: draws the random actions.
        greedy: the policy.

    Source: the released code's exploration policy, which Quillen et al. 2018 give no formula for.
    Differs: 1. The policy sees the true step; the released code's counts only the steps at which it was asked, so that
    it sees wrong ones in mixed episodes.
    """

    name: str
    exploration: float
    random: RandomPolicy
    greedy: Policy

    def act(self, observation: Observation, rng: np.random.Generator) -> np.ndarray:
        """Return an action, float32 [4] in [-1, 1].

        Args:
            observation: its step counts all actions taken so far, random ones too.
            rng: of the coin, the random action and the policy's search.
        """
        if rng.random() < self.exploration:
            return self.random.act(observation, rng)
        steps = np.asarray([observation.step], dtype=np.int64)
        pose = observation.gripper_pose[None]
        action: np.ndarray = self.greedy.decide(observation.image[None], steps, [rng], pose).actions[0]
        return action


@dataclasses.dataclass(frozen=True)
class LatestPolicy:
    """Makes the `ExploringPolicy` of a checkpoint in a worker process, which it travels to pickled.

    Attributes:
        run: the run's folder.
        step: training step of its checkpoint.
        exploration: probability of a random action.
        random: draws the random actions.
        cem: settings of the search.
    """

    run: Path
    step: int
    exploration: float
    random: RandomPolicy
    cem: CemSettings

    def __call__(self) -> ExploringPolicy:
        """Load the policy; it acts on one thread of the CPU, on one state at a time.

        The actions are so the same whatever the number of workers and cores.

        Raises:
            UserError: there is no such checkpoint, or it is damaged.
        """
        import torch

        from graspq.evaluate.runs import load_run

        torch.set_num_threads(1)
        policy, facts = load_run(self.run, self.step, self.cem, "cpu")
        return ExploringPolicy(f"{facts.algo}@{facts.step}", self.exploration, self.random, policy)
