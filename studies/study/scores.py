"""The scores of a study as JSON lines: what every run, reference and scene gave, all that its tables are reckoned from.

The file is made anew from the evaluations' own files each time, never added to.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from graspq.common.errors import UserError
from graspq.common.text import read_jsonl, write_jsonl
from graspq.datasets.manifest import MANIFEST_NAME, Manifest
from graspq.evaluate.records import Evaluation, finished_below
from graspq.evaluate.results_table import scored
from graspq.studies.study.cells import Cell
from graspq.studies.study.freezing import key_of, read_recipe
from graspq.studies.study.plan_file import StudyPlan
from graspq.studies.sweep.trial import SCENES_SEED, run_in

SCORES_FILE = "study.jsonl"
OF_AN_EVALUATION = (
    "episodes", "successes", "success_rate", "ci95_low", "ci95_high", "mean_steps", "object_set_sha256", "scored_by",
    "simulator", "outcomes",
)  # fmt: skip
KINDS = ("scenes", "reference", "run")


@dataclass(frozen=True)
class Published:
    """What was scored elsewhere and is not done again here.

    Attributes:
        runs: lines of runs by the names of their cells.
        beside: lines of policies without a run, and of the objects in the scenes, which the runs met.
    """

    runs: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    beside: tuple[dict[str, Any], ...] = ()

    def reference(self, policy: str, task: str) -> dict[str, Any] | None:
        """Return the line of a policy without a run on a task, if it is there."""
        found = (one for one in self.beside if one["kind"] == "reference")
        return next((one for one in found if (one["policy"], one["task"]) == (policy, task)), None)

    def scenes(self, task: str) -> dict[str, Any] | None:
        """Return the line of the objects in the scenes of a task, if it is there."""
        return next((one for one in self.beside if one["kind"] == "scenes" and one["task"] == task), None)


NOTHING = Published()


def write_scores(
    plan: StudyPlan, folder: Path, cells: Sequence[Cell], published: Published = NOTHING
) -> list[dict[str, Any]]:
    """Write the scores of a study; return them.

    A line is of a `kind`: `run`, see `run_row`; `reference`, a policy without a run; `scenes`, the objects that lay in
    each scene, in the order of the outcomes.

    Args:
        plan: the plan.
        folder: of the study.
        cells: its cells.
        published: lines that stand for what was scored elsewhere, see `published_scores`.
    """
    frozen = read_recipe(plan.recipe)["rows"] if plan.recipe.exists() else {}
    runs = [
        published.runs.get(cell.name) or run_row(plan, cell, frozen.get(key_of(cell), {}).get("digest") == cell.digest)
        for cell in cells
    ]
    references = list(_references(plan, folder, published))
    rows = [*_scenes(plan, folder, cells, published), *references, *runs]
    write_jsonl(folder / SCORES_FILE, rows)
    return rows


def published_scores(plan: StudyPlan, cells: Sequence[Cell], path: Path) -> Published:
    """Return the lines of published scores that are of the plan, which need not be done again then.

    Only what was trained by the very recipe, and scored on as many scenes of the same split, counts; not what failed.
    With it come the policies beside and the objects in the scenes that it met.

    Args:
        plan: the plan.
        cells: its cells.
        path: scores as `write_scores` writes them; none where the file is not there.

    Raises:
        UserError: it is no such file, or a line is of other data than those that lie here.
    """
    here = {(cell.row, cell.task, cell.size, cell.seed): cell for cell in cells}
    asked = {"split": plan.split, "setting": plan.values["setting"], "episodes": plan.values["episodes"]}
    found, digests = {}, dict[Path, str]()
    lines = read_scores([path]) if path.exists() else []
    for line in lines:
        if line["kind"] != "run" or line["status"] != "done":
            continue
        cell = here.get((line["row"], line["task"], line["size"], line["seed"]))
        wanted = asked | {"recipe_sha256": cell.digest if cell is not None else None}
        if cell is None or any(line.get(name) != value for name, value in wanted.items()):
            continue
        data = plan.dataset(cell.task, cell.size)
        if data not in digests and (data / MANIFEST_NAME).is_file():
            digests[data] = Manifest.load(data).digest()
        if digests.get(data, line["data_sha256"]) != line["data_sha256"]:
            raise UserError(f"{path}: {cell.name} was trained on other data than {data}; give another --results")
        found[cell.name] = line
    met = {_met(line) for line in found.values()}
    beside = [line for line in lines if line["kind"] == "reference" and _met(line) in met]
    places = {one[:3] for one in met}
    scenes = [line for line in lines if line["kind"] == "scenes"]
    beside += [one for one in scenes if (one["task"], one["split"], len(one["object_ids"])) in places]
    return Published(found, tuple(beside))


def _met(line: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return what says on which scenes a line was scored."""
    return line["task"], line["split"], line["episodes"], line["object_set_sha256"]


def run_row(plan: StudyPlan, cell: Cell, frozen: bool) -> dict[str, Any]:
    """Return what is known of a cell.

    Args:
        plan: the plan.
        cell: the cell.
        frozen: whether its settings are those of the plan's frozen recipe.
    """
    state, run = cell.state(), run_in(cell.run_folder)
    row: dict[str, Any] = {
        "kind": "run", "study": plan.name, "row": cell.row, "algo": cell.algo, "options": dict(cell.options),
        "task": cell.task, "size": cell.size, "setting": plan.values["setting"], "seed": cell.seed, "split": plan.split,
        "recipe_sha256": cell.digest, "recipe_frozen": frozen, "status": state.status, "steps": state.steps,
        "training_seconds": state.training_seconds, "reason": state.reason,
    }  # fmt: skip
    if run is not None:
        row["discount"] = run.config.get("discount")
        row["data_sha256"] = run.config.get("dataset", {}).get("manifest_sha256")
        row["trained_by"] = run.config.get("code_revision")
        metrics = run.metrics()
        validations = [one["validation"] for one in metrics if "validation" in one]
        row["fresh_grasps"] = fresh_grasps(metrics)
        row["validation"] = validations[-1] if validations else None
    return row | (_score(state.evaluation) if state.evaluation is not None else {})


def fresh_grasps(metrics: Iterable[Mapping[str, Any]]) -> int:
    """Return how many grasps of its own policies a run has added to its data; 0 where it was trained off-policy.

    Args:
        metrics: of the run, see `Run.metrics`.
    """
    return max((one["online"]["grasps_so_far"] for one in metrics if "online" in one), default=0)


def _score(evaluation: Evaluation) -> dict[str, Any]:
    """Return what a line says of an evaluation, as the table of `grasp-eval` does."""
    found = scored(evaluation)
    return {name: found[name] for name in OF_AN_EVALUATION}


def _references(plan: StudyPlan, folder: Path, published: Published) -> Iterator[dict[str, Any]]:
    for task in plan.values["tasks"]:
        for policy in plan.values["policies"]:
            found, elsewhere = reference(plan, folder, policy, task), published.reference(policy, task)
            if found is not None:
                own = {"kind": "reference", "policy": policy, "task": task, "split": plan.split}
                yield own | _score(found)
            elif elsewhere is not None:
                yield elsewhere


def _scenes(plan: StudyPlan, folder: Path, cells: Sequence[Cell], published: Published) -> Iterator[dict[str, Any]]:
    for task in plan.values["tasks"]:
        known = (reference(plan, folder, policy, task) for policy in plan.values["policies"])
        found = next((one for one in known if one is not None), None)
        if found is None:
            runs = (cell.state().evaluation for cell in cells if cell.task == task)
            found = next((one for one in runs if one is not None), None)
        if found is not None:
            ids = [list(row.object_ids) for row in found.rows()]
            yield {"kind": "scenes", "task": task, "split": plan.split, "seed": SCENES_SEED, "object_ids": ids}
        elif (elsewhere := published.scenes(task)) is not None:
            yield elsewhere


def reference(plan: StudyPlan, folder: Path, policy: str, task: str) -> Evaluation | None:
    """Return the score of a policy without a run on the scenes of a task, if it is there."""
    asked = {"label": policy, "task": task, "seed": SCENES_SEED}
    asked |= {"split": plan.split, "episodes": plan.values["episodes"]}
    for found in finished_below(folder / "references"):
        if all(found.summary.get(name) == value for name, value in asked.items()):
            return found
    return None


def read_scores(paths: Iterable[Path]) -> list[dict[str, Any]]:
    """Return the lines of files that `write_scores` wrote.

    Raises:
        UserError: one of them is missing or is no such file.
    """
    found: list[dict[str, Any]] = []
    for path in paths:
        lines = read_jsonl(path, ("kind",), "grasp-study run PLAN", "the scores of a study")
        if not lines or any(line["kind"] not in KINDS for line in lines):
            raise UserError(f"{path}: not the scores of a study; run grasp-study run PLAN")
        found += lines
    return found
