"""What a sweep tries: a trial for every point of the grid of each estimator, and each seed.

Source: Quillen et al. 2018, section "Analyzing Stability".
"""

import itertools
import math
from collections.abc import Iterator, Sequence

from graspq.common.errors import UserError
from graspq.studies.sweep.commands import training_options
from graspq.studies.sweep.settings import VARYING, SweepSettings, Varied
from graspq.studies.sweep.trial import Options, Trial
from graspq.train.estimators import ESTIMATORS, estimator_named

EXPLORATION_NOTE = (
    "Exploration: the paper prints the two durations as 10000 and 10000, an evident misprint, and does not say the "
    "other; 10000 is planned once. Its released code explores for 100000 steps: --exploration-steps 10000 100000 plans "
    "both."
)
STEPS_NOTE = "Steps: the paper does not state them; 2000000 are the released code's."
MOST_TRIALS = 100_000
# They decide which other options there are.
DECIDING = ("preset", "network")


def trials_of(settings: SweepSettings) -> list[Trial]:
    """Return the trials of complete settings; one seed's whole grid comes before the next seed's.

    Raises:
        UserError: an estimator is unknown, an option belongs to none of them, or there are too many points.
    """
    own = {name: tuple(f"{value:.12g}" for value in getattr(settings, name)) for name in VARYING}
    grid = [Varied(name, values) for name, values in (own | dict(settings.vary)).items() if values]
    if math.prod(len(varied.values) for varied in grid) > MOST_TRIALS:
        raise UserError(f"--vary: more than {MOST_TRIALS:,} points; give fewer values")
    points = {algo: list(_points(algo, settings.on_policy, grid)) for algo in settings.algo or ESTIMATORS}
    used = {name for point in itertools.chain(*points.values()) for name, _ in point}
    unused = {varied.name for varied in settings.vary} - used
    if unused:
        raise UserError(f"--vary {min(unused)}: no option of training with {', '.join(points)}; see grasp-train --help")
    return [
        Trial(settings, algo, point, seed)
        for seed in range(settings.seeds or 1)
        for algo in points
        for point in points[algo]
    ]


def _points(algo: str, on_policy: bool, grid: Sequence[Varied]) -> Iterator[Options]:
    """Yield the points of the grid of one estimator: all values of the options that it has."""
    for chosen in _product([varied for varied in grid if varied.name in DECIDING]):
        known = set(training_options(algo, on_policy, chosen)) - set(DECIDING)
        # Source: Quillen et al. 2018, the footnote that two algorithms do not use the discount.
        if getattr(estimator_named(algo).paper, "discount", None) is None:
            known -= {"discount"}  # γ is that of the data
        yield from (point + chosen for point in _product([varied for varied in grid if varied.name in known]))


def _product(grid: Sequence[Varied]) -> Iterator[Options]:
    names = [varied.name for varied in grid]
    return (tuple(zip(names, values, strict=True)) for values in itertools.product(*(one.values for one in grid)))


def notes_on(settings: SweepSettings) -> list[str]:
    """Return sentences on what the paper leaves open, and is not given."""
    asked = ((EXPLORATION_NOTE, not settings.exploration_steps), (STEPS_NOTE, settings.steps is None))
    return [note for note, holds in asked if holds and settings.preset == "paper"]
