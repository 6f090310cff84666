"""`grasp-objects`: makes object sets and draws their contact sheets.

Every option is a field of the frozen settings class of its command.
"""

import dataclasses
import sys
from pathlib import Path

import click
from tqdm import tqdm

from graspq.common.options import Group, Settings, options_from, setting, with_version
from graspq.objects.object_set import ObjectSet
from graspq.objects.procedural import COUNTS, LIMITS, SEED, make_procedural
from graspq.objects.shapes import FAMILIES
from graspq.objects.show import contact_sheet
from graspq.objects.targeted import make_targeted
from graspq.objects.third_party import LARGEST, SMALLEST, import_meshes


@dataclasses.dataclass(frozen=True)
class ProceduralSettings(Settings):
    """Options of `make procedural`."""

    folder: Path = setting(help="Folder of the set.", positional=True, metavar="FOLDER")
    seed: int = setting(SEED, help="Seed of all shapes, masses and colours; a whole number of at least 0.", minimum=0)
    train: int = setting(COUNTS["train"], help="Number of objects to train on, at least 1.", minimum=1)
    test: int = setting(COUNTS["test"], help="Number of held-out objects, at least 1.", minimum=1)
    validation: int = setting(
        COUNTS["validation"], help="Number of held-out objects to choose networks and settings by.", minimum=0
    )
    held_out_family: tuple[str, ...] = setting(
        (),
        help="Family that train and validation have no part of; test is of such families alone. May be repeated. One "
        f"of {', '.join(FAMILIES)}.",
    )
    graspable: float = setting(
        LIMITS.graspable,
        help="Least probability that an object rests so that the jaw can take it from above; 0 filters none out.",
        minimum=0,
        maximum=1,
    )


@dataclasses.dataclass(frozen=True)
class TargetedSettings(Settings):
    """Options of `make targeted`."""

    folder: Path = setting(help="Folder of the set.", positional=True, metavar="FOLDER")
    seed: int = setting(SEED, help="Seed of the distractors' shapes; a whole number of at least 0.", minimum=0)


@dataclasses.dataclass(frozen=True)
class ImportSettings(Settings):
    """Options of `make import`."""

    source: Path = setting(help="Folder of OBJ, STL or URDF files.", positional=True, metavar="SOURCE")
    folder: Path = setting(help="Folder of the set.", positional=True, metavar="FOLDER")
    scale: float = setting(1.0, help="Metres per unit of the files, above 0: 0.001 for files in millimetres.")
    density: float | None = setting(
        None, help="Density in kg/m³, above 0; without it a URDF's mass counts, else 450 kg/m³."
    )
    name: str | None = setting(None, help="Name of the set; without it the name of SOURCE.")
    split: str | None = setting(
        None,
        help="Split of all objects, such as test for a set that nothing is trained on; without it a tenth is test and "
        "the others train, each by its id alone.",
    )


@dataclasses.dataclass(frozen=True)
class ShowSettings(Settings):
    """Options of `show`."""

    folder: Path = setting(help="Folder of an object set.", positional=True, metavar="SET")
    out: Path = setting(help="The picture to write, a .png file.")
    split: str | None = setting(None, help="Only objects of this split, such as train or test.")
    count: int = setting(40, help="At most so many objects, the first of the set; at least 1.", minimum=1)
    by_family: int = setting(
        0, help="Instead the first so many objects of each main family, family by family.", minimum=0
    )


@click.group(cls=Group)
@with_version
def main() -> None:
    """Make the objects to grasp, and look at them."""


@main.group(cls=Group)
def make() -> None:
    """Make an object set: one OBJ and one URDF an object, and object_set.json."""


@make.command("procedural")
@options_from(ProceduralSettings)
def procedural(settings: ProceduralSettings) -> None:
    """Make random rigid objects, unions of convex parts from sixteen families, in train, test and validation."""
    there = _is_there(settings.folder)
    made = make_procedural(
        settings.folder,
        seed=settings.seed,
        train=settings.train,
        test=settings.test,
        validation=settings.validation,
        held_out=settings.held_out_family,
        graspable=settings.graspable,
    )
    _report(made, there)


@make.command("targeted")
@options_from(TargetedSettings)
def targeted(settings: TargetedSettings) -> None:
    """Make the set of the targeted task: a purple cross, four fixed distractors, twice four unseen ones."""
    there = _is_there(settings.folder)
    _report(make_targeted(settings.folder, seed=settings.seed), there)


@make.command("import", help=(
    f"Make a set of third-party meshes of {100 * SMALLEST:g} to {100 * LARGEST:g} cm; non-convex ones are decomposed, "
    "unusable ones left out and named."
))  # fmt: skip
@options_from(ImportSettings)
def import_(settings: ImportSettings) -> None:
    """Make a set of third-party meshes."""
    there = _is_there(settings.folder)
    made = import_meshes(
        settings.source,
        settings.folder,
        scale=settings.scale,
        density=settings.density,
        name=settings.name,
        split=settings.split,
        left_out=lambda line: tqdm.write(line, file=sys.stderr),
    )
    _report(made, there)


@main.command()
@options_from(ShowSettings)
def show(settings: ShowSettings) -> None:
    """Draw a labelled contact sheet (PNG) of an object set."""
    object_set = ObjectSet.load(settings.folder)
    shown = contact_sheet(
        object_set, settings.out, split=settings.split, count=settings.count, by_family=settings.by_family
    )
    click.echo(f"{settings.out}: {shown} objects")


def _is_there(folder: Path) -> bool:
    return folder.is_dir() and any(folder.iterdir())


def _report(made: ObjectSet, there: bool) -> None:
    splits = ", ".join(f"{len(made.ids(split))} {split}" for split in made.splits)
    state = "already there, identical" if there else "made"
    click.echo(f"{made.folder}: {len(made)} {made.name} objects ({splits}), {state}; sha256 {made.digest()[:12]}")
