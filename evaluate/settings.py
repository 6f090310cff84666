"""The settings of `grasp-eval`, and of the search (CEM) with which a Q-function picks its actions.

They are frozen dataclasses: the command line, `jobs.toml` and `eval.json` all carry these same names.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from graspq.common.errors import UserError
from graspq.common.options import Settings, parse_count, setting
from graspq.train.selection import Answer, StepMode

Device = Literal["auto", "cpu", "cuda"]
GROUP = 8  # environments of a batch; larger ones are cheaper, but leave workers waiting for the slowest of them
SYNTHETIC_STEP_HELP = (
    "How a motion of supervised becomes a step: scaled to the action limits, or each component clipped to them."
)


@dataclass(frozen=True)
class CemSettings(Settings):
    """The cross-entropy method over actions; see `graspq.train.selection.cross_entropy_method`.

    Source: Quillen et al. 2018 (3 iterations of 64 samples).
    """

    iterations: int = setting(3, help="Iterations of CEM.", minimum=1, maximum=100)
    samples: int = setting(64, help="Actions drawn in each iteration.", minimum=2, maximum=100_000)
    elites: int = setting(10, help="Best actions that a normal distribution is fitted to.", minimum=2)
    answer: Answer = setting("mean", help="The mean of the last elites, or the best of all samples.")
    synthetic_step: StepMode = setting("scale", help=SYNTHETIC_STEP_HELP)

    def __post_init__(self) -> None:
        """Check the ranges, and that there are no more elites than samples.

        Raises:
            UserError: one of them does not hold.
        """
        super().__post_init__()
        if self.elites > self.samples:
            raise UserError(f"CEM elites: expected at most as many as samples ({self.samples}), got {self.elites}")


@dataclass(frozen=True)
class EvalSettings(Settings):
    """Settings of `grasp-eval`; see each field's help."""

    runs: tuple[str, ...] = setting((), help="Run folders, or globs of them.", positional=True, metavar="[RUN]...")
    policy: tuple[str, ...] = setting(
        (), help="Score also this policy: random, oracle or your own as module:factory. May be repeated."
    )
    task: str | None = setting(
        None,
        help="Task: regular or targeted. Default: the run's own; without a run that of the runs beside, else regular.",
    )
    split: str = setting("test", help="Split of the object set; test-clutter for unseen distractors (targeted).")
    episodes: int = setting(1000, help="Episodes (grasps) of each job, such as 200 or 1k.", parse=parse_count)
    seed: int = setting(0, help="Seed of the scenes: the same seed gives every policy the same scenes.", minimum=0)
    objects: Path | None = setting(
        None, help="Folder of the object set. Default: the one the run's data were made with, else the task's own."
    )
    checkpoint: int | None = setting(None, help="Training step of the checkpoint. Default: the last.", minimum=0)
    workers: int | None = setting(None, help="Simulator processes, all cores by default; changes no result.", minimum=1)
    environments: int = setting(
        32, help=f"Simulated environments; groups of {GROUP} act in lockstep, as a batch.", minimum=1, maximum=1024
    )
    cem_iterations: int = setting(CemSettings.iterations, help="Iterations of CEM.", minimum=1, maximum=100)
    cem_samples: int = setting(CemSettings.samples, help="Actions drawn in each iteration of CEM.", minimum=2)
    cem_elites: int = setting(CemSettings.elites, help="Best actions that CEM is fitted to.", minimum=2)
    cem_answer: Answer = setting(
        CemSettings.answer, help="What CEM acts by: the mean of the last elites, or the best of all samples."
    )
    cem_synthetic_step: StepMode = setting(CemSettings.synthetic_step, help=SYNTHETIC_STEP_HELP)
    device: Device = setting("auto", help="Where the network runs.")
    out: Path | None = setting(
        None, help="Folder for the results and their table. Default: RUN/evaluations/, runs/baselines/ without a run."
    )
    films: int = setting(6, help="Episodes whose frames are kept for the report.", minimum=0, maximum=1000)
    video: Path | None = setting(None, help="Also write a video (.mp4 or .gif) of some episodes; one job only.")
    video_episodes: int = setting(4, help="Episodes in the video, from the first on.", minimum=1, maximum=1000)
    video_size: int = setting(256, help="Width and height of the video in pixels.", minimum=64, maximum=2048)
    jobs: Path | None = setting(None, help="TOML file of many jobs, instead of RUN and the options of one job.")
    again: bool = setting(False, help="Run jobs again that are finished already.")
    plan: bool = setting(False, help="Print the plan and stop.")

    @property
    def cem(self) -> CemSettings:
        """Return the settings of CEM."""
        return CemSettings(
            self.cem_iterations, self.cem_samples, self.cem_elites, self.cem_answer, self.cem_synthetic_step
        )
