"""Settings of the rounds of `grasp-online`; those of training stand beside them (`resolve`)."""

import dataclasses
from pathlib import Path
from typing import Any

from graspq.common.options import parse_count, setting
from graspq.engine import EngineSettings
from graspq.engine.settings import ENGINE_OPTIONS
from graspq.train.search_settings import CemOptions

# They may differ when a run is resumed: they do not decide what is collected.
FREE_SETTINGS = ENGINE_OPTIONS | {"start", "checkpoint", "objects"}


@dataclasses.dataclass(frozen=True)
class OnlineSettings(CemOptions, EngineSettings):
    """What `grasp-online` has beside the settings of training; see each field's help.

    Source: Quillen et al. 2018, section "Experimental Results", on-policy: 50 grasps each 1,000 steps. The exploration
    schedule is that of the released code; the paper's text prints its duration as "10000, 10000".
    """

    start: Path | None = setting(
        None,
        help="Run of grasp-train to go on from: its weights, optimiser, step, settings and shards; from scratch where "
        "not given.",
    )
    checkpoint: int | None = setting(None, help="Training step of the start run's checkpoint; its last.", minimum=0)
    rounds: int = setting(5, help="Rounds: first grasps, then training.", minimum=1)
    grasps: int = setting(50, help="Grasps of the latest policy in each round.", minimum=1)
    steps_per_round: int = setting(
        1_000, help="Gradient steps of each round, such as 500 or 1k.", minimum=1, parse=parse_count, metavar="COUNT"
    )
    exploration_start: float = setting(
        1.0, help="Probability of a random action in place of the policy's, at training step 0.", minimum=0, maximum=1
    )
    exploration_end: float = setting(
        0.05, help="That probability from --exploration-steps on; linear between.", minimum=0, maximum=1
    )
    exploration_steps: int = setting(
        100_000,
        help="Training steps (the start run's count) in which it gets there, such as 10k. The default is the released "
        "code's; the paper's text prints 10000.",
        minimum=1,
        parse=parse_count,
        metavar="COUNT",
    )
    descend_probability: float = setting(
        0.9, help="Probability that a random action moves straight down.", minimum=0, maximum=1
    )
    objects: Path | None = setting(
        None, help="Folder of the object set; the one that the base pool was made with where it is not given."
    )

    def exploration(self, step: int) -> float:
        """Return the probability of a random action at a training step.

        ε(n) = ε₀ + (ε₁ - ε₀) min(n / N, 1)
        """
        done = min(step / self.exploration_steps, 1.0)
        return self.exploration_start + (self.exploration_end - self.exploration_start) * done

    def deciding(self) -> dict[str, Any]:
        """Return the settings that decide what is collected, as JSON: those of the rounds, then those of the search."""
        values = {name: value for name, value in self.to_json().items() if name not in FREE_SETTINGS}
        return dict(sorted(values.items(), key=lambda item: item[0].startswith("cem_")))
