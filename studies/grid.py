"""The two grids of `grasp-sweep`, and the plan that the settings make of them.

Source: Quillen et al. 2018, section "Analyzing Stability".
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from graspq.common.errors import UserError
from graspq.studies.commands import training_options
from graspq.studies.plan import STEPS_PER_ROUND, Job, Plan
from graspq.studies.settings import PresetName, SweepSettings, Varied
from graspq.train.estimators import ESTIMATORS, estimator_named

PAPERS_ESTIMATORS = ("supervised", "dql", "mc", "corr-mc", "ddpg", "pcl")
EXPLORATION_NOTE = (
    "Exploration: the paper prints the two durations as 10000 and 10000, an evident misprint, and does not say the "
    "other; 10000 is planned once. Its released code explores for 100000 steps: --exploration-steps 10000 100000 plans "
    "both."
)
STEPS_NOTE = "Steps: the paper does not state them; 2000000 are the released code's."
# They decide which other options there are.
DECIDING = ("preset", "network")


@dataclass(frozen=True)
class Preset:
    """A grid and what its runs share.

    Attributes:
        on_policy: see `plan.Plan`.
        shards: the data, where none are named.
        learning_rate: learning rates.
        width: units of the paper's network.
        discount: γ of the estimators that use one.
        exploration_steps: durations of exploration; none without fresh grasps.
        seeds: number of seeds.
        steps: training steps.
        episodes: grasps of an evaluation.
    """

    on_policy: bool
    shards: tuple[str, ...]
    learning_rate: tuple[float, ...]
    width: tuple[int, ...]
    discount: tuple[float, ...]
    exploration_steps: tuple[int, ...]
    seeds: int
    steps: int
    episodes: int


PRESETS: dict[PresetName, Preset] = {
    "small": Preset(
        on_policy=False,
        shards=("data/regular-10k",),
        learning_rate=(0.01, 0.001, 0.0001),
        width=(32, 64),
        discount=(0.9, 0.95),
        exploration_steps=(),
        seeds=1,
        steps=5_000,
        episodes=200,
    ),
    "paper": Preset(
        on_policy=True,
        shards=("data/regular-100k",),
        learning_rate=(0.01, 0.001, 0.0001),
        width=(32, 64),
        discount=(0.9, 0.95),
        exploration_steps=(10_000,),
        seeds=9,
        steps=2_000_000,
        episodes=1000,
    ),
}


def make_plan(settings: SweepSettings) -> Plan:
    """Return the plan of some settings; one seed's whole grid comes before the next seed's.

    Raises:
        UserError: an estimator is unknown, an option belongs to none of them, exploration is asked of runs that have
            none, or a round would be cut short.
    """
    preset = PRESETS[settings.preset]
    if settings.exploration_steps and not preset.on_policy:
        raise UserError(
            f"--exploration-steps: --preset {settings.preset} learns from shards alone and never explores; "
            "leave it out, or use --preset paper"
        )
    steps = preset.steps if settings.steps is None else settings.steps
    if preset.on_policy and steps % STEPS_PER_ROUND != 0:
        raise UserError(f"--steps: expected a multiple of {STEPS_PER_ROUND}, the steps of an online round, got {steps}")
    return Plan(
        preset=settings.preset,
        on_policy=preset.on_policy,
        shards=settings.shards or preset.shards,
        objects=str(settings.objects) if settings.objects is not None else None,
        split=settings.split,
        steps=steps,
        episodes=preset.episodes if settings.episodes is None else settings.episodes,
        notes=_notes(settings),
        jobs=_jobs(settings, preset),
    )


def _jobs(settings: SweepSettings, preset: Preset) -> tuple[Job, ...]:
    algorithms = settings.algo or (tuple(ESTIMATORS) if settings.preset == "small" else PAPERS_ESTIMATORS)
    grid = _grid(settings, preset)
    points = {algo: list(_points(algo, preset.on_policy, grid)) for algo in dict.fromkeys(algorithms)}
    unused = {varied.name for varied in settings.vary} - {
        name for point in itertools.chain(*points.values()) for name, _ in point
    }
    if unused:
        raise UserError(f"--vary {min(unused)}: no option of training with {', '.join(points)}; see grasp-train --help")
    seeds = range(preset.seeds if settings.seeds is None else settings.seeds)
    return tuple(Job(algo, point, seed) for seed in seeds for algo in points for point in points[algo])


def _grid(settings: SweepSettings, preset: Preset) -> list[Varied]:
    """Return all options that vary: those of the preset, then the others."""
    usual = ("learning_rate", "width", "discount", "exploration_steps")
    chosen = {name: getattr(settings, name) or getattr(preset, name) for name in usual}
    own = {name: tuple(f"{value:.12g}" for value in values) for name, values in chosen.items() if values}
    return [Varied(*pair) for pair in (own | dict(settings.vary)).items()]


def _points(algo: str, on_policy: bool, grid: Sequence[Varied]) -> Iterator[tuple[tuple[str, str], ...]]:
    """Yield the points of the grid of one estimator: all values of the options that it has."""
    deciding = [varied for varied in grid if varied.name in DECIDING]
    for chosen in _product(deciding):
        known = training_options(algo, on_policy, chosen)
        others = [varied for varied in grid if varied.name in known and varied.name not in DECIDING]
        if not _uses_discount(algo):
            others = [varied for varied in others if varied.name != "discount"]
        yield from (point + chosen for point in _product(others))


def _product(grid: Sequence[Varied]) -> Iterator[tuple[tuple[str, str], ...]]:
    names = [varied.name for varied in grid]
    return (tuple(zip(names, values, strict=True)) for values in itertools.product(*(one.values for one in grid)))


def _uses_discount(algo: str) -> bool:
    """Return whether γ is a setting of an estimator, and not that of the data.

    Source: Quillen et al. 2018, the footnote that two algorithms do not use the discount.
    """
    return getattr(estimator_named(algo).paper, "discount", None) is not None


def _notes(settings: SweepSettings) -> tuple[str, ...]:
    if settings.preset != "paper":
        return ()
    asked = ((EXPLORATION_NOTE, not settings.exploration_steps), (STEPS_NOTE, settings.steps is None))
    return tuple(note for note, holds in asked if holds)
