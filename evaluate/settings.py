"""The settings of `grasp-eval`: the command line, `jobs.toml` and `eval.json` carry these same names."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from graspq.common.options import parse_count, setting
from graspq.engine import EngineSettings
from graspq.train.search_settings import CemOptions, CemSettings, StepMode

Device = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True)
class EvalSettings(CemOptions, EngineSettings):
    """Settings of `grasp-eval`; see each field's help."""

    runs: tuple[str, ...] = setting((), help="Run folders, or globs of them.", positional=True, metavar="[RUN]...")
    policy: tuple[str, ...] = setting(
        (),
        help="Score also this policy: random, oracle or module:factory, whose code is run. May be repeated.",
    )
    task: str | None = setting(
        None,
        help="Task: regular, targeted or module:task. Default: the run's own; without a run that of the runs beside, "
        "else regular.",
    )
    split: str = setting(
        "validation",
        help="Split of the object set: validation, to choose by; test (targeted: test-clutter too), for the one score "
        "of a recipe that is frozen; train.",
    )
    episodes: int = setting(1000, help="Episodes (grasps) of each job, such as 200 or 1k.", parse=parse_count)
    seed: int = setting(0, help="Seed of the scenes: the same seed gives every policy the same scenes.", minimum=0)
    objects: Path | None = setting(
        None,
        help="Folder of the object set. Default: the one the run's data were made with, else the task's own. Where it "
        "is another (by its digest), a split with a mesh that the run was trained on is refused.",
    )
    checkpoint: int | None = setting(None, help="Training step of the checkpoint. Default: the last.", minimum=0)
    cem_synthetic_step: StepMode = setting(
        CemSettings.synthetic_step,
        help="How a motion of supervised becomes a step: scaled to the limits, or each part clipped to them.",
    )
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
