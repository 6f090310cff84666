"""The policy of a trained Q-function: the cross-entropy method over actions, its trunk computed once for a state.

Dimension key: B batch rows, I iterations, N samples, A action, H W C image.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from graspq.evaluate.policies import ACTION_DIMENSIONS, Decision, Policy
from graspq.evaluate.settings import CemSettings
from graspq.train.selection import cross_entropy_method

if TYPE_CHECKING:
    from graspq.train.networks import QNetwork


class QPolicy(Policy):
    """Picks a = argmax Q(s, a) by the cross-entropy method; each state's noise comes from its own generator."""

    def __init__(self, network: "QNetwork", cem: CemSettings, device: torch.device) -> None:
        self.network, self.cem, self.device = network.to(device).eval(), cem, device

    def decide(
        self, images: np.ndarray, steps: np.ndarray, generators: Sequence[np.random.Generator | None]
    ) -> Decision:
        """Search the best action of each state; see `Policy.decide`."""
        noise = self._noise(generators)
        with torch.inference_mode():
            q_of_actions = self.network.at(
                torch.from_numpy(np.ascontiguousarray(images)).to(self.device),
                torch.from_numpy(np.asarray(steps, dtype=np.int64)).to(self.device),
            )
            choice = cross_entropy_method(
                q_of_actions,
                torch.from_numpy(noise).to(self.device),
                elites=self.cem.elites,
                answer=self.cem.answer,
            )
            actions, q = choice.action.float().cpu().numpy(), choice.q.float().cpu().numpy()
        return Decision(np.clip(actions, -1, 1), q)

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
