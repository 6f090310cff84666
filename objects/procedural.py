"""The procedural object set: random unions of convex parts, sized so that a gripper of 8 cm opening can take them.

Object i of a split is a pure function of (seed, families, split, i): a smaller set is the beginning of a larger one.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
import trimesh

from graspq.common.errors import UserError
from graspq.common.seeding import generator
from graspq.objects.geometry import half_spaces
from graspq.objects.graspable import graspable_share
from graspq.objects.model import Color, ObjectModel, Solid, draw_color
from graspq.objects.object_set import ObjectSet
from graspq.objects.shapes import FAMILIES, SIMPLE, draw_shape
from graspq.objects.writing import write_object_set

# Changes with every change of the rules below, of the families or of the file format: it stands in object_set.json.
GENERATOR_VERSION = "2"
SEED = 1
COUNTS = {"train": 900, "test": 100, "validation": 100}
_MOST_DRAWS = 1000
_SIZES_A_SHAPE = 4
Bounds: TypeAlias = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Limits:
    """What an object must keep, each as (least, greatest); metres, kg, kg/m³.

    `longest`: the longest side of the bounding box. `thickness`: of every part, at least, so that fingers that hold
    something never close. `graspable`: least probability that it rests so that the jaw can take it. `triangles`: at
    most so many, so that rendering stays fast.
    """

    longest: Bounds = (0.04, 0.16)
    mass: Bounds = (0.015, 0.150)
    density: Bounds = (150.0, 1800.0)
    thickness: float = 0.008
    graspable: float = 0.85
    triangles: int = 400


LIMITS = Limits()


def make_procedural(
    folder: Path | str,
    *,
    seed: int,
    train: int = COUNTS["train"],
    test: int = COUNTS["test"],
    validation: int = COUNTS["validation"],
    held_out: Sequence[str] = (),
    graspable: float = LIMITS.graspable,
) -> ObjectSet:
    """Make the procedural set and return it.

    Args:
        folder: where; missing, empty, or the same set already.
        seed: whole number ≥ 0.
        train: objects of the split "train", ids train_000 and so on.
        test: objects of the split "test", never seen in training.
        validation: objects of the split "validation", which choices are made on; may be 0.
        held_out: families that have no part in "train" and "validation"; "test" is then of these alone.
        graspable: least probability, 0 to 1, that an object rests so that the jaw can take it.

    Raises:
        UserError: the counts are not positive, the seed is negative, a family is unknown or none is left, or the folder
            holds something else.
    """
    if seed < 0:
        raise UserError(f"--seed: expected a whole number of at least 0, got {seed}")
    if train < 1 or test < 1 or validation < 0:
        raise UserError(
            f"--train, --test and --validation: expected at least 1, 1 and 0 objects, got {train}, {test}, {validation}"
        )
    unknown = [name for name in held_out if name not in FAMILIES]
    if unknown or set(held_out) == set(FAMILIES):
        raise UserError(f"--held-out-family {' '.join(unknown or held_out)}: choose some of {', '.join(FAMILIES)}")
    counts = {"train": train, "test": test, "validation": validation}
    filtered = [] if graspable == LIMITS.graspable else [f"graspable{graspable:g}"]
    return write_object_set(
        Path(folder),
        _models(seed, counts, tuple(name for name in FAMILIES if name in held_out), graspable),
        name="-".join(["procedural", *(["without", *sorted(set(held_out))] if held_out else []), *filtered]),
        generator_version=GENERATOR_VERSION,
        seed=seed,
        total=sum(counts.values()),
    )


def _models(seed: int, counts: dict[str, int], held_out: tuple[str, ...], graspable: float) -> Iterator[ObjectModel]:
    for split, count in counts.items():
        for index in range(count):
            yield procedural_object(seed, split, index, held_out, graspable)


def families_of(split: str, held_out: Sequence[str]) -> tuple[str, ...]:
    """Return the families that a split's objects are of."""
    others = tuple(name for name in FAMILIES if name not in held_out)
    return tuple(held_out) if held_out and split == "test" else others


def main_family(seed: int, split: str, index: int, families: Sequence[str] = tuple(FAMILIES)) -> str:
    """Return the main family of an object: every run of as many objects as families holds each of them once."""
    run, place = divmod(index, len(families))
    order = generator("objects/families", seed, list(COUNTS).index(split), run).permutation(len(families))
    return families[int(order[place])]


def procedural_object(
    seed: int, split: str, index: int, held_out: Sequence[str] = (), graspable: float = LIMITS.graspable
) -> ObjectModel:
    """Return one object, a pure function of its arguments; `split` is "train", "test" or "validation"."""
    rng = generator("objects/procedural", seed, list(COUNTS).index(split), index)
    extras = [name for name in SIMPLE if split == "test" or name not in held_out]
    family = main_family(seed, split, index, families_of(split, held_out))
    color = draw_color(rng)
    return draw_object(
        rng, family, extras, object_id=f"{split}_{index:03d}", split=split, color=color, graspable=graspable
    )


def draw_object(
    rng: np.random.Generator,
    family: str,
    extras: Sequence[str] = tuple(SIMPLE),
    *,
    object_id: str,
    split: str,
    color: Color,
    graspable: float = LIMITS.graspable,
) -> ObjectModel:
    """Draw objects of a main family in several sizes until one keeps `LIMITS`, and `graspable`, and return it.

    The logarithms of size and mass are even, that of the mass within what size and density leave.
    """
    for _ in range(_MOST_DRAWS):
        shape = draw_shape(rng, family, extras)
        if sum(len(part.faces) for part in shape.parts) > LIMITS.triangles:
            continue
        solid = Solid.of(shape.parts)
        length, thin = float(np.ptp(solid.points, axis=0).max()), min(thickness(part) for part in solid.parts)
        for _ in range(_SIZES_A_SHAPE):
            scale = _even_logarithm(rng, LIMITS.longest) / length
            volume = solid.volume * scale**3
            lightest = max(LIMITS.mass[0], LIMITS.density[0] * volume)
            heaviest = min(LIMITS.mass[1], LIMITS.density[1] * volume)
            if thin * scale < LIMITS.thickness or lightest > heaviest:
                continue
            mass = _even_logarithm(rng, (lightest, heaviest))
            model = solid.model(
                object_id=object_id, split=split, families=shape.families, color=color, mass=mass, scale=scale
            )
            if graspable_share(model.parts) >= graspable:
                return model
    raise RuntimeError(f"no {family} within the limits in {_MOST_DRAWS} draws")


def _even_logarithm(rng: np.random.Generator, bounds: Bounds) -> float:
    return math.exp(rng.uniform(math.log(bounds[0]), math.log(bounds[1])))


def thickness(part: trimesh.Trimesh) -> float:
    """Return the least distance between a face of a convex part and the corner farthest from it."""
    planes = half_spaces(part)
    return float(-(planes[:, :3] @ part.vertices.T + planes[:, 3:]).min(axis=1).max())
