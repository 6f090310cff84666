"""The settings of `grasp-sweep`; where one is not given, the preset decides.

Lists such as `--learning-rate 0.01 0.001` replace a preset's own; the rest of its grid stays.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from graspq.common.errors import UserError
from graspq.common.options import Settings, flag, parse_count, setting

PresetName = Literal["small", "paper"]


@dataclass(frozen=True)
class SweepSettings(Settings):
    """Settings of `grasp-sweep`; see each field's help."""

    preset: PresetName = setting(
        "small",
        help="small: grasp-train on 10k grasps, one seed; paper: grasp-online from 100k grasps, nine seeds.",
    )
    algo: tuple[str, ...] = setting((), help="Estimators. Default: all of the table (small), the paper's six (paper).")
    shards: tuple[str, ...] = setting(
        (), help="Dataset folders, shard files or globs. Default: data/regular-10k (small), data/regular-100k (paper)."
    )
    objects: Path | None = setting(None, help="Object set of the evaluations. Default: the one of the data.")
    split: str = setting("test", help="Split of the object set that runs are scored on.")
    learning_rate: tuple[float, ...] = setting((), help="Learning rates. Default: 0.01, 0.001 and 0.0001.")
    width: tuple[int, ...] = setting((), help="Units of the paper's network. Default: 32 and 64.")
    discount: tuple[float, ...] = setting((), help="Discounts of the estimators that use one. Default: 0.9 and 0.95.")
    exploration_steps: tuple[int, ...] = setting(
        (), help="Training steps over which exploration falls (paper). Default: 10000, which the paper prints twice."
    )
    seeds: int | None = setting(None, help="Training seeds, from 0 on. Default: 1 (small), 9 (paper).", minimum=1)
    steps: int | None = setting(
        None, help="Training steps of each run, such as 5k. Default: 5k (small), 2M (paper).", parse=parse_count
    )
    episodes: int | None = setting(
        None, help="Grasps that each run is scored on. Default: 200 (small), 1000 (paper).", parse=parse_count
    )
    device: Literal["auto", "cpu", "cuda"] = setting("auto", help="Where networks run.")
    jobs: int = setting(1, help="How many jobs run at a time; they share the cores.", minimum=1)
    threads: int | None = setting(None, help="CPU threads of each job. Default: cores / jobs.", minimum=1)
    out: Path | None = setting(None, help="Folder of the sweep; runs/sweep-PRESET where it is not given.")
    retry_failed: bool = setting(False, help="Run jobs again that failed.")
    dry_run: bool = setting(False, help="Print the plan and stop; nothing is written.")

    def __post_init__(self) -> None:
        """Check all values.

        Raises:
            UserError: a value is unknown or out of range.
        """
        super().__post_init__()
        self._check("learning_rate", lambda value: value > 0, "numbers above 0")
        self._check("width", lambda value: value >= 1, "numbers of at least 1")
        self._check("discount", lambda value: 0 <= value <= 1, "numbers of 0 to 1")
        self._check("exploration_steps", lambda value: value >= 1, "numbers of at least 1")

    def _check(self, name: str, good: Callable[[float], bool], expected: str) -> None:
        for value in getattr(self, name):
            if not good(value):
                raise UserError(f"{flag(name)}: expected {expected}, got {value}")

    @property
    def folder(self) -> Path:
        """The sweep's folder: `out`, or its default."""
        return self.out if self.out is not None else Path("runs") / f"sweep-{self.preset}"
