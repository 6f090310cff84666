"""The frozen recipe: the settings of every row that decide what is learned, with their digests, in a file.

Choices are made on `validation`; what was chosen is written down, and only then is a plan allowed to score on `test`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from graspq.common.checksums import read_checked_json, write_checked_json
from graspq.common.errors import UserError
from graspq.common.provenance import code_revision
from graspq.evaluate.records import identity_digest
from graspq.studies.study.cells import Cell
from graspq.studies.study.plan_file import StudyPlan

FORMAT_VERSION = 1


def key_of(cell: Cell) -> str:
    """Return what a recipe calls the settings of a cell: those of its row at its size."""
    return f"{cell.row}-{cell.size}"


def recipe_of(plan: StudyPlan, cells: Sequence[Cell]) -> dict[str, Any]:
    """Return the recipe of a plan as JSON: for every row at every size its settings and their digest."""
    rows = {key_of(cell): {"digest": cell.digest, **cell.deciding} for cell in cells}
    return {
        "format_version": FORMAT_VERSION,
        "study": plan.name,
        "digest": identity_digest({name: row["digest"] for name, row in rows.items()}),
        "code_revision": code_revision(),
        "rows": rows,
    }


def freeze(plan: StudyPlan, cells: Sequence[Cell]) -> Path:
    """Write the recipe of a plan; one that is there already and says the same is kept.

    Raises:
        UserError: another recipe is there.
    """
    fresh, path = recipe_of(plan, cells), plan.recipe
    if path.exists():
        if read_recipe(path)["digest"] != fresh["digest"]:
            raise UserError(
                f"{path}: holds another recipe, and one is frozen once; delete it only if test was not opened with it"
            )
        return path
    write_checked_json(path, fresh)
    return path


def read_recipe(path: Path) -> dict[str, Any]:
    """Return the recipe in a file.

    Raises:
        UserError: there is none, or its digests are not those of what it says.
    """
    found = read_checked_json(path, "frozen recipe", "restore it")
    try:
        rows = {
            name: identity_digest({key: value for key, value in row.items() if key != "digest"})
            for name, row in found["rows"].items()
        }
        whole = found["digest"] == identity_digest(rows) and found["format_version"] == FORMAT_VERSION
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path}: not a frozen recipe ({error!r}); make one with grasp-study freeze PLAN") from None
    if not whole or any(found["rows"][name]["digest"] != digest for name, digest in rows.items()):
        raise UserError(f"{path}: edited by hand, its digests are not those of its settings; restore it")
    return found


def require_frozen(plan: StudyPlan, cells: Sequence[Cell]) -> None:
    """Refuse a plan that would open `test` with settings that are not frozen.

    Raises:
        UserError: the recipe is missing, or a row's settings are others.
    """
    if not plan.opens_test:
        return
    if not plan.recipe.exists():
        raise UserError(
            f"{plan.path}: {plan.split} is opened with a frozen recipe alone, and {plan.recipe} is not there; "
            f"choose on validation, then run: grasp-study freeze {plan.path}"
        )
    rows = read_recipe(plan.recipe)["rows"]
    for cell in cells:
        there = rows.get(key_of(cell))
        if there is None:
            raise UserError(
                f"{plan.recipe}: freezes no row {key_of(cell)}; {plan.path} cannot score it on {plan.split}"
            )
        if there["digest"] != cell.digest:
            raise UserError(
                f"{key_of(cell)}: {difference(there, cell.deciding)} in {plan.recipe}; {plan.split} is opened with the "
                "frozen recipe alone"
            )


def difference(there: Any, here: Any, name: str = "") -> str:
    """Say where two settings first differ: `learning_rate = 0.001 now, 0.002`."""
    if isinstance(there, dict) and isinstance(here, dict):
        for key in [*here, *(key for key in there if key not in here and key != "digest")]:
            if there.get(key) != here.get(key):
                return difference(there.get(key), here.get(key), key)
    return f"{name} = {here} now, {there}"
