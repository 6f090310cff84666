"""Settings of the search by which a Q-function acts; apart from `selection`, so that commands start without PyTorch."""

import dataclasses
from typing import Literal

from graspq.common.errors import UserError
from graspq.common.options import Settings, flag, setting

Answer = Literal["mean", "best", "last"]
StepMode = Literal["scale", "clip"]


@dataclasses.dataclass(frozen=True)
class CemSettings(Settings):
    """The search by which a Q-function acts; see `selection.cross_entropy_method`.

    Source: Quillen et al. 2018 (3 iterations of 64 samples).
    """

    iterations: int = setting(3, help="Iterations of CEM.", minimum=1, maximum=100)
    samples: int = setting(64, help="Actions drawn in each iteration.", minimum=2, maximum=100_000)
    elites: int = setting(10, help="Best actions that a normal distribution is fitted to.", minimum=2)
    answer: Answer = setting("mean", help="The mean of the last elites, or the best sample, of all or of the last.")
    views: int = setting(6, help="Pictures of a state of which the smallest Q counts.", minimum=1, maximum=6)
    synthetic_step: StepMode = setting(
        "scale", help="How a motion of supervised becomes a step: scaled to the limits, or each part clipped to them."
    )

    def __post_init__(self) -> None:
        """Check the ranges, and that there are no more elites than samples.

        Raises:
            UserError: one of them does not hold.
        """
        super().__post_init__()
        if self.elites > self.samples:
            raise UserError(f"CEM elites: expected at most as many as samples ({self.samples}), got {self.elites}")

    def words(self) -> list[str]:
        """Return the options of a command that give this search; those at their defaults are left out."""
        usual = CemSettings()
        given = {name: value for name, value in self.to_json().items() if value != getattr(usual, name)}
        return [word for name, value in given.items() for word in (flag(f"cem_{name}"), str(value))]


@dataclasses.dataclass(frozen=True)
class CemOptions(Settings):
    """The search as options of a command."""

    cem_iterations: int = setting(CemSettings.iterations, help="Iterations of CEM.", minimum=1, maximum=100)
    cem_samples: int = setting(CemSettings.samples, help="Actions drawn in each iteration of CEM.", minimum=2)
    cem_elites: int = setting(CemSettings.elites, help="Best actions that CEM is fitted to.", minimum=2)
    cem_answer: Answer = setting(
        CemSettings.answer,
        help="What CEM acts by: the mean of the last elites, the best of all samples, or of the last iteration's.",
    )

    cem_views: int = setting(
        CemSettings.views,
        help="Shifted and mirrored pictures of a state, of which the smallest Q counts; 1: the picture alone.",
        minimum=1,
        maximum=6,
    )

    def __post_init__(self) -> None:
        """Check all values.

        Raises:
            UserError: a value is unknown or out of range.
        """
        super().__post_init__()
        _ = self.cem  # refuses more elites than samples

    @property
    def cem(self) -> CemSettings:
        """The search by which a Q-function acts."""
        names = [field.name for field in dataclasses.fields(CemSettings) if hasattr(self, f"cem_{field.name}")]
        return CemSettings(**{name: getattr(self, f"cem_{name}") for name in names})
