"""The plan of a study: a TOML file that says which rows are trained on what, how often, and where they are scored."""

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graspq.common.errors import UserError
from graspq.common.files import read_toml
from graspq.common.options import parse_count
from graspq.evaluate.jobs import checked_policy
from graspq.evaluate.over_seeds import FEWEST_SCENES
from graspq.studies.sweep.grid import MOST_TRIALS
from graspq.studies.sweep.settings import SET_BY_SWEEP
from graspq.studies.sweep.trial import Options
from graspq.train.estimators import estimator_named
from graspq.train.search_settings import CemOptions

OFF_POLICY, ON_POLICY = "off-policy", "on-policy"
# What a plan may say: its key, its kinds, what is taken where it is not said, what was expected.
KEYS: dict[str, tuple[tuple[type, ...], Any, str]] = {
    "rows": ((list,), None, "a list of estimators, each a name or a table such as {algo = 'nstep', n = [1, 3]}"),
    "sizes": ((list,), None, "a list of dataset sizes, such as ['10k']"),
    "tasks": ((list,), ["regular"], "a list of tasks"),
    "seeds": ((int,), 1, "a number of training seeds"),
    "setting": ((str,), OFF_POLICY, f"{OFF_POLICY} or {ON_POLICY}"),
    "preset": ((str,), "default", "default or paper"),
    "options": ((dict,), {}, "a table of options of training"),
    "steps": ((int, str), None, "a number of training steps, such as 3000"),
    "split": ((str,), "validation", "a split of the object set"),
    "episodes": ((int,), 1000, f"a number of grasps that each run is scored on, at least {FEWEST_SCENES}"),
    "cem": ((dict,), {}, "a table of settings of the search, such as {answer = 'last', views = 1}"),
    "policies": ((list,), ["random", "oracle"], "a list of policies to score beside the rows"),
    "reference": ((str,), None, "the name of a row"),
    "recipe": ((str,), None, "the file of a frozen recipe"),
    "data": ((str,), "data", "a folder of datasets"),
    "engine": ((str,), "local", "local or ray"),
    "ray_address": ((str,), None, "an address of a Ray cluster"),
    "workers": ((int,), None, "a number of trainings at a time"),
    "threads": ((int,), 1, "a number of threads of each training"),
}
CHOICES = {"setting": (OFF_POLICY, ON_POLICY), "preset": ("default", "paper"), "engine": ("local", "ray")}


@dataclass(frozen=True)
class Row:
    """One row of a study's table: an estimator with some options.

    Attributes:
        name: what tables call it.
        algo: the estimator.
        options: options of training, as a command line gives them; `preset` among them.
        steps: training steps; None: as the amount of data asks.
    """

    name: str
    algo: str
    options: Options
    steps: int | None


@dataclass(frozen=True)
class StudyPlan:
    """What `read_plan` found in a file.

    Attributes:
        path: of the file; its name names the study.
        rows: the estimators.
        sizes: sizes of the datasets, as people write them.
        values: whatever else it says, see `KEYS`.
    """

    path: Path
    rows: tuple[Row, ...]
    sizes: tuple[str, ...]
    values: Mapping[str, Any]

    @property
    def name(self) -> str:
        """The study's name."""
        return self.path.stem

    @property
    def on_policy(self) -> bool:
        """Whether the rows add fresh grasps."""
        return bool(self.values["setting"] == ON_POLICY)

    @property
    def split(self) -> str:
        """Split that all is scored on."""
        return str(self.values["split"])

    @property
    def opens_test(self) -> bool:
        """Whether it scores on objects that nothing may be chosen on."""
        return self.split.startswith("test")

    @property
    def recipe(self) -> Path:
        """File of the frozen recipe."""
        named = self.values["recipe"]
        return Path(named) if named is not None else Path("results") / f"recipe-{self.name}.json"

    @property
    def search(self) -> dict[str, Any]:
        """Settings of the search by which rows act, as options of `grasp-eval` by name; none where all are usual."""
        return {f"cem_{name}": value for name, value in self.values["cem"].items()}

    def dataset(self, task: str, size: str) -> Path:
        """Return the folder of a dataset, as `grasp-datagen` names it."""
        return Path(self.values["data"]) / f"{task.replace(':', '.')}-{size}"


def read_plan(path: Path) -> StudyPlan:
    """Return the plan in a TOML file; `KEYS` says what may stand in it.

    A row is a name, or a table of `algo` and options of training: those that are lists are multiplied out, and each of
    the rows is named by its values, or by `name` where there is one alone. `steps` and `preset` may stand there too.

    Raises:
        UserError: the file cannot be read, or says something that is none of this.
    """
    content = read_toml(path, "no such plan; studies/plans/ holds examples")
    for key, value in content.items():
        kinds, _, expected = KEYS.get(key, ((), None, ""))
        if not kinds:
            raise UserError(f"{path}: unknown key {key!r}; expected some of {', '.join(KEYS)}")
        if type(value) not in kinds or (value == [] and key != "policies") or (type(value) is int and value < 1):
            raise UserError(f"{path}: {key} = {value!r}; expected {expected}")
        if key in ("tasks", "policies") and not all(isinstance(one, str) for one in value):
            raise UserError(f"{path}: {key} = {value!r}; expected {expected}")
    values = {key: content.get(key, usual) for key, (_, usual, _) in KEYS.items()}
    for key, allowed in CHOICES.items():
        if values[key] not in allowed:
            raise UserError(f"{path}: {key} = {values[key]!r}; expected {KEYS[key][2]}")
    for key in ("rows", "sizes"):
        if values[key] is None:
            raise UserError(f"{path}: {key} is missing; expected {KEYS[key][2]}")
    if values["episodes"] < FEWEST_SCENES:
        raise UserError(f"{path}: episodes = {values['episodes']}; expected {KEYS['episodes'][2]}")
    try:
        rows = tuple(row for entry in values["rows"] for row in _rows(entry, values))
        for size in values["sizes"]:
            parse_count(str(size))
        for policy in values["policies"]:
            checked_policy(policy)
        plan = StudyPlan(path, rows, tuple(map(str, values["sizes"])), values)
        CemOptions.from_json(plan.search)
    except (UserError, ValueError) as error:
        raise UserError(f"{path}: {error}") from None
    names = [row.name for row in rows]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UserError(f"{path}: two rows are called {twice!r}; give one of them a name of its own")
    if values["reference"] not in (None, *names):
        raise UserError(f"{path}: reference = {values['reference']!r}; expected a row: {', '.join(names)}")
    return plan


def _rows(entry: Any, values: Mapping[str, Any]) -> Iterator[Row]:
    """Yield the rows that an entry of `rows` stands for."""
    own = {"algo": entry} if isinstance(entry, str) else entry
    if not isinstance(own, dict) or not isinstance(own.get("algo"), str):
        raise UserError(f"rows: {entry!r}; expected {KEYS['rows'][2]}")
    own = dict(own)
    algo, name = own.pop("algo"), own.pop("name", None)
    preset = own.get("preset", values["preset"])
    estimator = estimator_named(algo)
    asked = own.pop("steps", values["steps"] or estimator.recipe_of(preset).steps)
    steps = None if asked is None else parse_count(str(asked))
    taken = sorted({*own, *values["options"]} & SET_BY_SWEEP)
    if taken:
        raise UserError(f"rows: {taken[0]}: the study sets it of each training; use the plan's own keys")
    if not (name is None or isinstance(name, str)) or not isinstance(preset, str):
        raise UserError(f"rows: {entry!r}; expected words for name and preset")
    varied = {key: value if isinstance(value, list) else [value] for key, value in own.items()}
    if math.prod(map(len, varied.values())) > MOST_TRIALS:
        raise UserError(f"rows: {algo}: its lists make more than {MOST_TRIALS:,} rows; give fewer values")
    points = list(itertools.product(*varied.values()))
    if name is not None and len(points) > 1:
        raise UserError(f"rows: {name!r} would name {len(points)} rows; leave the name out, or the lists")
    for point in points:
        chosen = dict(zip(varied, map(_text, point), strict=True))
        shared = {key: _text(value) for key, value in values["options"].items()}
        label = name or "-".join([algo, *(f"{key.replace('_', '')}{value}" for key, value in chosen.items())])
        yield Row(label, algo, tuple(({"preset": preset} | shared | chosen).items()), steps)


def _text(value: Any) -> str:
    """Return an option's value as a command line gives it."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.12g}" if isinstance(value, float) else str(value)
