"""Jobs: which policy meets which scenes. They come from the command line or from a TOML file, as one list.

A job is one policy, task, split, object set, seed and number of episodes; a file's lists are multiplied out.
"""

import glob
import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from graspq.common.errors import UserError, said_of
from graspq.common.files import read_toml
from graspq.common.options import MOST
from graspq.evaluate.records import ORACLE, RANDOM
from graspq.evaluate.settings import EvalSettings
from graspq.train.search_settings import CemSettings

LISTS = ("runs", "policies", "tasks", "splits", "objects", "seeds")
SINGLES = ("episodes", "checkpoint", "cem")
RUN_FILE = "config.json"
MOST_JOBS = 100_000


@dataclass(frozen=True)
class Job:
    """One evaluation to be made.

    Attributes:
        run: folder of the training run; None for a policy without one.
        policy: `random`, `oracle` or `module:factory`; None for a run.
        task: name of the task; None for the run's own; without a run that of the plan's runs, else `regular`.
        split: split of the object set.
        seed: seed of the scenes.
        episodes: number of episodes.
        objects: folder of the object set; None to find the run's own.
        checkpoint: training step; None for the last.
        cem: settings of the search.
    """

    run: Path | None
    policy: str | None
    task: str | None = None
    split: str = "validation"
    seed: int = 0
    episodes: int = 1000
    objects: Path | None = None
    checkpoint: int | None = None
    cem: CemSettings = field(default_factory=CemSettings)

    @property
    def label(self) -> str:
        """Return the name that tables and reports show."""
        return self.policy if self.policy is not None else (self.run or Path()).resolve().name


def jobs_from_settings(settings: EvalSettings) -> list[Job]:
    """Return the jobs of a command line: its runs, then its policies.

    Raises:
        UserError: there are none, a glob finds nothing, a policy's name is none, or `--jobs` meets other jobs.
    """
    if settings.jobs is not None:
        if settings.runs or settings.policy:
            raise UserError("--jobs names all jobs itself; leave out RUN and --policy, or leave out --jobs")
        return read_jobs(settings.jobs, settings)
    if not settings.runs and not settings.policy:
        raise UserError("nothing to evaluate; give run folders, --policy random|oracle|module:factory, or --jobs FILE")
    return _product({"runs": settings.runs, "policies": settings.policy}, settings)


def read_jobs(path: Path, settings: EvalSettings) -> list[Job]:
    """Return the jobs of a TOML file.

    Its top level holds defaults for its `[[jobs]]` tables, or, without such tables, one of them. Keys: the lists `runs`
    (folders or globs), `policies`, `tasks`, `splits`, `objects` and `seeds`, and `episodes`, `checkpoint` and `cem`
    (a table of iterations, samples, elites, answer). What a file leaves out comes from the command line's options.

    Raises:
        UserError: the file cannot be read, or a key or a value in it is none of these.
    """
    content = read_toml(path, "no such jobs file")
    tables = content.pop("jobs", [{}])
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise UserError(f"{path}: jobs is no list of tables; write each as [[jobs]]")
    jobs: list[Job] = []
    for number, table in enumerate(tables, start=1):
        merged = {**content, **table}
        where = f"{path}, job table {number}"
        _check_keys(merged, where)
        with said_of(where):
            jobs += _product(merged, settings)
    return list(dict.fromkeys(jobs))


def _check_keys(table: dict[str, Any], where: str) -> None:
    for key, value in table.items():
        if key not in LISTS + SINGLES:
            raise UserError(f"{where}: unknown key {key!r}; expected some of {', '.join(LISTS + SINGLES)}")
        kind, name = (int, "whole numbers") if key == "seeds" else (str, "strings")
        if key in LISTS and not (isinstance(value, list) and value and all(type(item) is kind for item in value)):
            raise UserError(f"{where}: {key} = {value!r}; expected a list of {name}")
        if key in ("episodes", "checkpoint") and (type(value) is not int or value < (key == "episodes")):
            raise UserError(f"{where}: {key} = {value!r}; expected a whole number")
        if key == "seeds" and min(value) < 0:
            raise UserError(f"{where}: seeds = {value!r}; a seed is at least 0")
        if key == "cem" and not (isinstance(value, dict) and all(type(item) in (int, str) for item in value.values())):
            raise UserError(f"{where}: cem = {value!r}; expected a table of the settings of CEM")
    if not table.get("runs") and not table.get("policies"):
        raise UserError(f"{where}: neither runs nor policies; name at least one")


def _product(table: dict[str, Any], settings: EvalSettings) -> list[Job]:
    """Multiply a table's lists out; what it lacks comes from the settings."""
    players: list[tuple[Path | None, str | None]] = [(run, None) for run in find_runs(table.get("runs", ()))]
    players += [(None, checked_policy(policy)) for policy in table.get("policies", ())]
    cem = CemSettings.from_json({**settings.cem.to_json(), **table.get("cem", {})})
    episodes, step = (table.get(name, getattr(settings, name)) for name in ("episodes", "checkpoint"))
    objects = [Path(folder) for folder in table["objects"]] if "objects" in table else [settings.objects]
    if any(isinstance(one, int) and one > MOST for one in (episodes, step)):
        raise UserError(f"episodes = {episodes}, checkpoint = {step}: expected at most {MOST:,}")
    tasks, splits, seeds = (table.get(f"{name}s", [getattr(settings, name)]) for name in ("task", "split", "seed"))
    count = math.prod(map(len, (tasks, splits, objects, seeds, players)))
    if count > MOST_JOBS:
        raise UserError(f"{count:,} jobs; expected at most {MOST_JOBS:,}")
    return [
        Job(run, policy, task, split, seed, episodes, folder, step if run is not None else None, cem)
        for task, split, folder, seed, (run, policy) in itertools.product(tasks, splits, objects, seeds, players)
    ]


def find_runs(patterns: Iterable[str]) -> list[Path]:
    """Return the run folders that names and globs stand for, each once, in order; a glob passes over other folders.

    Raises:
        UserError: a glob finds no run.
    """
    found: dict[Path, None] = {}
    for pattern in patterns:
        if not glob.has_magic(pattern) or Path(pattern).exists():
            found[Path(pattern)] = None
            continue
        matches = [Path(match) for match in sorted(glob.glob(pattern, recursive=True))]  # noqa: PTH207
        runs = [match for match in matches if (match / RUN_FILE).is_file()]
        if not runs:
            raise UserError(f"{pattern}: no run folder matches; expected folders that grasp-train wrote")
        found.update(dict.fromkeys(runs))
    return list(found)


def checked_policy(name: str) -> str:
    """Return a policy's name if it can be one.

    Raises:
        UserError: it is neither random, oracle nor module:factory.
    """
    module, colon, factory = name.partition(":")
    if name not in (RANDOM, ORACLE) and not (module and colon and factory):
        raise UserError(f"--policy: {name!r} is unknown; choose random, oracle, or module:factory of your own")
    return name
