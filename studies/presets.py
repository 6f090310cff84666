"""The two grids of `grasp-sweep`, and the plan that the settings make of them.

Source: Quillen et al. 2018, section "Analyzing Stability".
"""

import itertools
from dataclasses import dataclass

from graspq.common.errors import UserError
from graspq.studies.plan import STEPS_PER_ROUND, Job, Plan
from graspq.studies.settings import PresetName, SweepSettings
from graspq.train.estimators import ESTIMATORS, estimator_named

# Source: Quillen et al. 2018: the table of algorithms, and the footnote that two of them do not use the discount.
PAPER_USES_DISCOUNT = {"supervised": False, "dql": True, "mc": False, "corr-mc": True, "ddpg": True, "pcl": True}
EXPLORATION_NOTE = (
    "Exploration: the paper prints the two durations as 10000 and 10000, an evident misprint, and does not say the "
    "other; 10000 is planned once. Its released code explores for 100000 steps: --exploration-steps 10000 100000 plans "
    "both."
)
STEPS_NOTE = "Steps: the paper does not state them; 2000000 are the released code's."


@dataclass(frozen=True)
class Preset:
    """A grid and what its runs share.

    Attributes:
        on_policy: see `plan.Plan`.
        shards: the data, where none are named.
        learning_rates: learning rates.
        widths: units of the paper's network.
        discounts: γ of the estimators that use one.
        exploration_steps: durations of exploration; none without fresh grasps.
        seeds: number of seeds.
        steps: training steps.
        episodes: grasps of an evaluation.
    """

    on_policy: bool
    shards: tuple[str, ...]
    learning_rates: tuple[float, ...]
    widths: tuple[int, ...]
    discounts: tuple[float, ...]
    exploration_steps: tuple[int, ...]
    seeds: int
    steps: int
    episodes: int


PRESETS: dict[PresetName, Preset] = {
    "small": Preset(
        on_policy=False,
        shards=("data/regular-10k",),
        learning_rates=(0.01, 0.001, 0.0001),
        widths=(32, 64),
        discounts=(0.9, 0.95),
        exploration_steps=(),
        seeds=1,
        steps=5_000,
        episodes=200,
    ),
    "paper": Preset(
        on_policy=True,
        shards=("data/regular-100k",),
        learning_rates=(0.01, 0.001, 0.0001),
        widths=(32, 64),
        discounts=(0.9, 0.95),
        exploration_steps=(10_000,),
        seeds=9,
        steps=2_000_000,
        episodes=1000,
    ),
}


def make_plan(settings: SweepSettings) -> Plan:
    """Return the plan of some settings; one seed's whole grid comes before the next seed's.

    Raises:
        UserError: an estimator is unknown, exploration is asked of runs that have none, or a round would be cut short.
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
        jobs=tuple(dict.fromkeys(_jobs(settings, preset))),
    )


def _jobs(settings: SweepSettings, preset: Preset) -> list[Job]:
    algorithms = settings.algo or (tuple(ESTIMATORS) if settings.preset == "small" else tuple(PAPER_USES_DISCOUNT))
    rates, widths = settings.learning_rate or preset.learning_rates, settings.width or preset.widths
    explorations: tuple[int | None, ...] = settings.exploration_steps or preset.exploration_steps or (None,)
    discounts: tuple[float | None, ...] = settings.discount or preset.discounts
    jobs = []
    for seed, algo in itertools.product(range(preset.seeds if settings.seeds is None else settings.seeds), algorithms):
        used = discounts if uses_discount(algo, settings.preset) else (None,)
        for rate, width, discount, exploration in itertools.product(rates, widths, used, explorations):
            jobs.append(Job(algo, rate, width, discount, exploration, seed))
    return jobs


def _notes(settings: SweepSettings) -> tuple[str, ...]:
    if settings.preset != "paper":
        return ()
    asked = ((EXPLORATION_NOTE, not settings.exploration_steps), (STEPS_NOTE, settings.steps is None))
    return tuple(note for note, holds in asked if holds)


def uses_discount(algo: str, preset: PresetName) -> bool:
    """Return whether γ varies for an estimator; the paper's own are known to the paper's plan before they are built.

    Raises:
        UserError: there is no such estimator.
    """
    if preset == "paper" and algo in PAPER_USES_DISCOUNT:
        return PAPER_USES_DISCOUNT[algo]
    row = estimator_named(algo)
    return row.takes_discount and row.discount is not None
