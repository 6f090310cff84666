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
from graspq.objects.procedural import make_procedural
from graspq.objects.show import contact_sheet
from graspq.objects.targeted import make_targeted
from graspq.objects.third_party import LARGEST, SMALLEST, import_meshes


@dataclasses.dataclass(frozen=True)
class ProceduralSettings(Settings):
    """Options of `make procedural`."""

    folder: Path = setting(help="Folder of the set.", positional=True, metavar="FOLDER")
    seed: int = setting(0, help="Seed of all shapes, masses and colours; a whole number of at least 0.", minimum=0)
    train: int = setting(900, help="Number of objects to train on, at least 1.", minimum=1)
    test: int = setting(100, help="Number of held-out objects, at least 1.", minimum=1)


@dataclasses.dataclass(frozen=True)
class TargetedSettings(Settings):
    """Options of `make targeted`."""

    folder: Path = setting(help="Folder of the set.", positional=True, metavar="FOLDER")
    seed: int = setting(0, help="Seed of the distractors' shapes; a whole number of at least 0.", minimum=0)


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


@dataclasses.dataclass(frozen=True)
class ShowSettings(Settings):
    """Options of `show`."""

    folder: Path = setting(help="Folder of an object set.", positional=True, metavar="SET")
    out: Path = setting(help="The picture to write, a .png file.")
    split: str | None = setting(None, help="Only objects of this split, such as train or test.")
    count: int = setting(40, help="At most so many objects, the first of the set; at least 1.", minimum=1)


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
    """Make random rigid objects, unions of convex parts from eight families, split into train and test."""
    there = _is_there(settings.folder)
    made = make_procedural(settings.folder, seed=settings.seed, train=settings.train, test=settings.test)
    _report(made, there)


@make.command("targeted")
@options_from(TargetedSettings)
def targeted(settings: TargetedSettings) -> None:
    """Make the set of the targeted task: a purple cross, four fixed and four unseen distractors."""
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
        left_out=lambda line: tqdm.write(line, file=sys.stderr),
    )
    _report(made, there)


@main.command()
@options_from(ShowSettings)
def show(settings: ShowSettings) -> None:
    """Draw a labelled contact sheet (PNG) of an object set."""
    shown = contact_sheet(ObjectSet.load(settings.folder), settings.out, split=settings.split, count=settings.count)
    click.echo(f"{settings.out}: {shown} objects")


def _is_there(folder: Path) -> bool:
    return folder.is_dir() and any(folder.iterdir())


def _report(made: ObjectSet, there: bool) -> None:
    splits = ", ".join(f"{len(made.ids(split))} {split}" for split in made.splits)
    state = "already there, identical" if there else "made"
    click.echo(f"{made.folder}: {len(made)} {made.name} objects ({splits}), {state}; sha256 {made.digest()[:12]}")
