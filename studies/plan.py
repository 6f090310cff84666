"""A sweep as data: a list of jobs, each named by what it is and done when its output is there, and what they share.

`plan.json` in the sweep's folder is this plan; whether a job is done stands in the job's own files alone (`state`).
"""

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graspq.common.errors import UserError
from graspq.common.files import read_json, write_json

PLAN_FILE = "plan.json"
FORMAT_VERSION = 2
# Source: Quillen et al. 2018, section "Experimental Results": on-policy runs add 50 grasps each 1,000 training steps.
STEPS_PER_ROUND, GRASPS_PER_ROUND = 1_000, 50
_SHORT = {"learning_rate": "lr", "exploration_steps": "exploration"}


@dataclass(frozen=True)
class Job:
    """One training and its evaluation.

    Attributes:
        algo: the estimator.
        options: what varies besides: name of an option of training, its value as a command line gives it.
        seed: seed of the training.
    """

    algo: str
    options: tuple[tuple[str, str], ...]
    seed: int

    @property
    def id(self) -> str:
        """Return the job's name, made of what varies: `dql-lr0.001-width32-discount0.9-seed0`.

        It depends on the job alone, so that a grid that grows keeps the names it has.
        """
        parts = [self.algo, *(f"{_SHORT.get(name, name)}{value}" for name, value in self.options), f"seed{self.seed}"]
        return "-".join(re.sub(r"[^A-Za-z0-9._+-]+", ".", part) for part in parts)

    def to_json(self) -> dict[str, Any]:
        """Return what varies as plain JSON values, the name first."""
        return {"id": self.id, "algo": self.algo, "options": dict(self.options), "seed": self.seed}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "Job":
        """Return the job that `to_json` wrote."""
        return cls(values["algo"], tuple(values["options"].items()), values["seed"])


@dataclass(frozen=True)
class Plan:
    """All jobs of a sweep and what they share.

    Attributes:
        preset: `small` or `paper`.
        on_policy: whether runs add fresh grasps (grasp-online) or learn from the shards alone (grasp-train).
        shards: dataset folders, shard files or globs.
        objects: folder of the object set; None for the one of the data.
        split: split that runs are scored on.
        steps: training steps of each job.
        episodes: grasps that each job is scored on.
        notes: sentences on what the plan had to decide.
        jobs: the jobs, in the order in which they run.
    """

    preset: str
    on_policy: bool
    shards: tuple[str, ...]
    objects: str | None
    split: str
    steps: int
    episodes: int
    notes: tuple[str, ...]
    jobs: tuple[Job, ...]

    @property
    def varied(self) -> tuple[str, ...]:
        """Names of the options that vary, in the order in which jobs name them."""
        return tuple(dict.fromkeys(name for job in self.jobs for name, _ in job.options))

    def to_json(self) -> dict[str, Any]:
        """Return the content of `plan.json`."""
        shared = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {"format_version": FORMAT_VERSION, **shared, "jobs": [job.to_json() for job in self.jobs]}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "Plan":
        """Return the plan that `to_json` wrote."""
        jobs = tuple(Job.from_json(job) for job in values["jobs"])
        shared = {field.name: values[field.name] for field in dataclasses.fields(cls)}
        tuples = {"shards": tuple(values["shards"]), "notes": tuple(values["notes"]), "jobs": jobs}
        return cls(**shared | tuples)


def read_plan(folder: Path) -> Plan | None:
    """Return the plan of a sweep's folder, or None where there is none yet.

    Raises:
        UserError: the file is no plan of this format.
    """
    path = folder / PLAN_FILE
    if not path.exists():
        return None
    values = read_json(path, "plan of a sweep")
    if not isinstance(values, dict) or values.get("format_version") != FORMAT_VERSION:
        raise UserError(f"{path}: expected the plan of a sweep, format {FORMAT_VERSION}; choose another --out")
    try:
        return Plan.from_json(values)
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path}: not a whole plan of a sweep ({error}); choose another --out") from None


def write_plan(folder: Path, plan: Plan) -> None:
    """Write `plan.json`, atomically."""
    write_json(folder / PLAN_FILE, plan.to_json())


def joined(older: Plan | None, plan: Plan, folder: Path) -> Plan:
    """Return the plan with the jobs that the folder's plan has beside: a sweep can grow.

    Args:
        older: the plan that the folder holds, if any.
        plan: the one that was asked for.
        folder: for the message.

    Raises:
        UserError: the folder's jobs are of another kind and would not stand in one table.
    """
    if older is None:
        return plan
    for name in ("preset", "on_policy", "split", "steps", "episodes"):
        theirs, ours = getattr(older, name), getattr(plan, name)
        if theirs != ours:
            raise UserError(f"{folder}: holds a sweep with {name} = {theirs}, not {ours}; choose another --out")
    others = tuple(job for job in older.jobs if job not in plan.jobs)
    return dataclasses.replace(plan, jobs=plan.jobs + others)
