"""The policies of a trained Q-function: the cross-entropy method over actions, its trunk computed once for a state.

Dimension key: B batch rows, I iterations, N samples, A action, H W C image.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from graspq.evaluate.policies import ACTION_DIMENSIONS, Decision, Policy
from graspq.evaluate.settings import CemSettings
from graspq.sim.task import TaskSettings
from graspq.train.selection import SearchSpace, cross_entropy_method, one_step_of
from graspq.train.supervised import cut_to, motions_at

if TYPE_CHECKING:
    from graspq.train.networks import QNetwork


class QPolicy(Policy):
    """Picks a = argmax Q(s, a) by the cross-entropy method; each state's noise comes from its own generator."""

    def __init__(self, network: "QNetwork", cem: CemSettings, device: torch.device) -> None:
        self.network, self.cem, self.device = network.to(device).eval(), cem, device

    def decide(
        self,
        images: np.ndarray,
        steps: np.ndarray,
        generators: Sequence[np.random.Generator | None],
        poses: np.ndarray | None = None,
    ) -> Decision:
        """Search the best action of each state; see `Policy.decide`."""
        noise = torch.from_numpy(self._noise(generators)).to(self.device)
        step = torch.from_numpy(np.asarray(steps, dtype=np.int64)).to(self.device)
        with torch.inference_mode():
            choice = cross_entropy_method(
                self.network.at(torch.from_numpy(np.ascontiguousarray(images)).to(self.device), step),
                noise,
                elites=self.cem.elites,
                answer=self.cem.answer,
                space=self._space(step, None if poses is None else torch.from_numpy(poses).to(self.device)),
            )
            action = self._executed(choice.action.float())
        return Decision(np.clip(action.cpu().numpy(), -1, 1), choice.q.float().cpu().numpy())

    def _space(self, step: torch.Tensor, pose: torch.Tensor | None) -> SearchSpace | None:
        """Return where to search at steps int64 [B] from poses float [B, A]; None for a step's own actions."""
        return None

    def _executed(self, found: torch.Tensor) -> torch.Tensor:
        """Return the actions, [B, A], for what the search found."""
        return found

    def _noise(self, generators: Sequence[np.random.Generator | None]) -> np.ndarray:
        """Draw float32 [I, B, N, A], the same numbers for a state whatever batch it is in."""
        drawn = (self.cem.iterations, self.cem.samples, ACTION_DIMENSIONS)
        noise = np.zeros((self.cem.iterations, len(generators), *drawn[1:]), dtype=np.float32)
        for row, own in enumerate(generators):
            if own is not None:
                noise[:, row] = own.standard_normal(drawn, dtype=np.float32)
        return noise

    def identity(self) -> dict[str, Any]:
        """Return the search's settings."""
        return {"cem": self.cem.to_json()}


class SyntheticPolicy(QPolicy):
    """Searches the whole motion to the last pose, as `supervised` learns it, and takes its first step.

    The motion lies in the range of the training data at that step, and where the gripper's pose is given it ends inside
    the workspace. It is planned anew at every step.
    """

    def __init__(
        self,
        network: "QNetwork",
        cem: CemSettings,
        device: torch.device,
        extra: dict[str, torch.Tensor],
        task: TaskSettings,
    ) -> None:
        super().__init__(network, cem, device)
        self.extra = {name: tensor.to(device) for name, tensor in extra.items()}
        low, high = task.workspace_bounds
        self.low, self.high, self.limits = (torch.tensor(row, device=device) for row in (low, high, task.action_limits))

    def _space(self, step: torch.Tensor, pose: torch.Tensor | None) -> SearchSpace:
        space = motions_at(self.extra, step)
        if pose is None:
            return space
        return cut_to(space, (self.low - pose) / self.limits, (self.high - pose) / self.limits)

    def _executed(self, found: torch.Tensor) -> torch.Tensor:
        return one_step_of(found, self.cem.synthetic_step)
