"""The settings of `grasp-sweep`; where one is not given, the preset decides.

Lists such as `--learning-rate 0.01 0.001` replace a preset's own; the rest of its grid stays.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from graspq.common.errors import UserError
from graspq.common.machine import available_cores
from graspq.common.options import MOST, flag, parse_count, setting
from graspq.engine import EngineSettings
from graspq.train.search_settings import CemOptions

# Source of both grids: Quillen et al. 2018, section "Analyzing Stability".
GRID: dict[str, Any] = {"learning_rate": (0.01, 0.001, 0.0001), "width": (32, 64), "discount": (0.9, 0.95)}
PRESETS: dict[str, dict[str, Any]] = {
    "small": {**GRID, "shards": ("data/regular-10k",), "seeds": 1, "steps": 5_000, "episodes": 200},
    "paper": {
        **GRID, "shards": ("data/regular-100k",), "seeds": 9, "steps": 2_000_000, "episodes": 1000,
        "exploration_steps": (10_000,), "algo": ("supervised", "dql", "mc", "corr-mc", "ddpg", "pcl"),
    },
}  # fmt: skip
VARYING = ("learning_rate", "width", "discount", "exploration_steps")
# Source: section "Experimental Results": on-policy runs add 50 grasps each 1,000 training steps.
STEPS_PER_ROUND, GRASPS_PER_ROUND = 1_000, 50
# What the sweep itself says of each of its trainings.
SET_BY_SWEEP = frozenset({"algo", "shards", "out", "seed", "steps", "threads", "device", "objects", "start"})


class Varied(NamedTuple):
    """An option of training by its name, and the values that it takes, as a command line would give them."""

    name: str
    values: tuple[str, ...]


def parse_varied(text: str) -> Varied:
    """Return what `NAME=V1,V2` says; dashes and underscores are the same.

    Raises:
        ValueError: it says something else.
    """
    name, _, values = text.partition("=")
    found = tuple(dict.fromkeys(value.strip() for value in values.split(",")))
    if not name or not all(found):
        raise ValueError("expected an option of training and its values, such as anneal=0.1,1 or mirror=true,false")
    return Varied(name.strip().lstrip("-").replace("-", "_"), found)


@dataclass(frozen=True)
class SweepSettings(CemOptions, EngineSettings):
    """Settings of `grasp-sweep`; see each field's help."""

    preset: Literal["small", "paper"] = setting(
        "small",
        help="small: grasp-train on 10k grasps, one seed; paper: grasp-online from 100k grasps, nine seeds.",
    )
    algo: tuple[str, ...] = setting((), help="Estimators. Default: all of the table (small), the paper's six (paper).")
    shards: tuple[str, ...] = setting(
        (), help="Dataset folders, shard files or globs. Default: data/regular-10k (small), data/regular-100k (paper)."
    )
    objects: Path | None = setting(None, help="Object set of the evaluations. Default: the one of the data.")
    split: str = setting(
        "validation", help="Split of the object set that runs are scored on: points are chosen on validation alone."
    )
    learning_rate: tuple[float, ...] = setting((), help="Learning rates. Default: 0.01, 0.001 and 0.0001.")
    width: tuple[int, ...] = setting((), help="Units of the paper's network. Default: 32 and 64.")
    discount: tuple[float, ...] = setting((), help="Discounts of the estimators that use one. Default: 0.9 and 0.95.")
    exploration_steps: tuple[int, ...] = setting(
        (), help="Training steps over which exploration falls (paper). Default: 10000, which the paper prints twice."
    )
    vary: tuple[Varied, ...] = setting(
        (),
        help="Any other option of training and its values, such as anneal=0.1,1 or mirror=true,false; of the "
        "estimators that have it. May be repeated.",
        parse=parse_varied,
        metavar="NAME=V1,V2",
    )
    seeds: int | None = setting(
        None, help="Training seeds, from 0 on. Default: 1 (small), 9 (paper).", minimum=1, maximum=1000
    )
    steps: int | None = setting(
        None,
        help="Training steps of each run, such as 5k. Default: 5k (small), 2M (paper).",
        parse=parse_count,
        minimum=1,
        maximum=MOST,
    )
    episodes: int | None = setting(
        None,
        help="Grasps that each run is scored on. Default: 200 (small), 1000 (paper).",
        parse=parse_count,
        minimum=1,
        maximum=MOST,
    )
    device: Literal["auto", "cpu", "cuda"] = setting("auto", help="Where networks run.")
    workers: int | None = setting(
        None,
        help="How many jobs run at a time. Default: 1, on Ray as many as the cluster has cores for; 0 runs them in "
        "this process.",
        minimum=0,
    )
    threads: int | None = setting(
        None, help="CPU threads of each job. Default: cores / workers, 1 on Ray.", minimum=1, maximum=1024
    )
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
        names = [varied.name for varied in self.vary]
        for name in names:
            if name in SET_BY_SWEEP:
                raise UserError(f"--vary {name}: the sweep sets {flag(name)} of each training; use its own options")
            if names.count(name) > 1:
                raise UserError(f"--vary {name}: named twice; give all its values once, as {name}=V1,V2")
            if getattr(self, name, ()) and name in VARYING:
                raise UserError(f"--vary {name}: {flag(name)} names values too; use one of them")

    def _check(self, name: str, good: Callable[[float], bool], expected: str) -> None:
        for value in getattr(self, name):
            if not good(value):
                raise UserError(f"{flag(name)}: expected {expected}, got {value}")

    @property
    def on_policy(self) -> bool:
        """Whether runs add fresh grasps (grasp-online) or learn from the shards alone (grasp-train)."""
        return self.preset == "paper"

    @property
    def folder(self) -> Path:
        """The sweep's folder: `out`, or its default."""
        return self.out if self.out is not None else Path("runs") / f"sweep-{self.preset}"

    def complete(self) -> "SweepSettings":
        """Return the settings with the preset's values, and this machine's, where none are given.

        Raises:
            UserError: exploration is asked of runs that have none, or a round would be cut short.
        """
        if self.exploration_steps and not self.on_policy:
            raise UserError(
                f"--exploration-steps: --preset {self.preset} learns from shards alone and never explores; "
                "leave it out, or use --preset paper"
            )
        local = self.engine == "local"
        workers = 1 if local and self.workers is None else self.workers
        threads = max(available_cores() // max(workers or 1, 1), 1) if local else 1
        usual = PRESETS[self.preset] | {"workers": workers, "threads": threads}
        given = [name for name in usual if getattr(self, name) not in (None, ())] + [one.name for one in self.vary]
        missing = {name: value for name, value in usual.items() if name not in given}
        found = dataclasses.replace(self, out=self.folder.absolute(), **missing)
        if self.on_policy and (found.steps or 0) % STEPS_PER_ROUND != 0:
            raise UserError(
                f"--steps: expected a multiple of {STEPS_PER_ROUND}, the steps of an online round, got {found.steps}"
            )
        return found
