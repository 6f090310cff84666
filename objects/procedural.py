"""The procedural object set: random unions of convex parts, sized so that a gripper of 8 cm opening can take them.

Object i of a split is a pure function of (seed, split, i): a smaller set is the beginning of a larger one.
"""

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np

from graspq.common.errors import UserError
from graspq.common.seeding import generator
from graspq.objects.geometry import Array
from graspq.objects.model import Color, ObjectModel, Solid, draw_color
from graspq.objects.object_set import ObjectSet
from graspq.objects.resting import resting_poses
from graspq.objects.shapes import COMPOSITE, FAMILIES, draw_shape
from graspq.objects.writing import write_object_set

# Changes with every change of the rules below, of the families or of the file format: it stands in object_set.json.
GENERATOR_VERSION = "1"
SPLITS = ("train", "test")
_MOST_DRAWS = 1000
Bounds: TypeAlias = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Limits:
    """What makes an object fit for the gripper, each as (least, greatest); metres, kg, kg/m³.

    `longest`: the longest side of the bounding box. `height` and `width` (the least horizontal width) hold in resting
    poses that together have a probability of `share`. `typical_width`: mean of the width over resting poses, of simple
    objects and of rings and brackets, which a finger can also enter. `triangles`: at most so many, so that rendering
    stays fast.
    """

    longest: Bounds = (0.045, 0.11)
    height: Bounds = (0.023, 0.11)
    width: Bounds = (0.018, 0.058)
    typical_width: tuple[Bounds, Bounds] = ((0.024, 0.046), (0.026, 0.056))
    share: float = 0.97
    density: Bounds = (350.0, 650.0)
    mass: Bounds = (0.018, 0.15)
    triangles: int = 200


LIMITS = Limits()


def make_procedural(folder: Path | str, *, seed: int, train: int = 900, test: int = 100) -> ObjectSet:
    """Make the procedural set and return it.

    Args:
        folder: where; missing, empty, or the same set already.
        seed: whole number ≥ 0.
        train: objects of the split "train", ids train_000 and so on.
        test: objects of the split "test", never seen in training.

    Raises:
        UserError: the counts are not positive, the seed is negative, or the folder holds something else.
    """
    if seed < 0:
        raise UserError(f"--seed: expected a whole number of at least 0, got {seed}")
    if train < 1 or test < 1:
        raise UserError(f"--train and --test: expected at least 1 object each, got {train} and {test}")
    return write_object_set(
        Path(folder),
        _models(seed, {"train": train, "test": test}),
        name="procedural",
        generator_version=GENERATOR_VERSION,
        seed=seed,
        total=train + test,
    )


def _models(seed: int, counts: dict[str, int]) -> Iterator[ObjectModel]:
    for split, count in counts.items():
        for index in range(count):
            yield procedural_object(seed, split, index)


def main_family(seed: int, split: str, index: int) -> str:
    """Return the main family of an object: every run of eight objects holds each of the eight families once."""
    names = list(FAMILIES)
    order = generator("objects/families", seed, SPLITS.index(split), index // len(names)).permutation(len(names))
    return names[int(order[index % len(names)])]


def procedural_object(seed: int, split: str, index: int) -> ObjectModel:
    """Return one object, a pure function of its arguments; `split` is "train" or "test"."""
    rng = generator("objects/procedural", seed, SPLITS.index(split), index)
    return draw_object(
        rng, main_family(seed, split, index), object_id=f"{split}_{index:03d}", split=split, color=draw_color(rng)
    )


def draw_object(rng: np.random.Generator, family: str, *, object_id: str, split: str, color: Color) -> ObjectModel:
    """Draw objects of a main family until one can be sized to keep `LIMITS`, and return it."""
    for _ in range(_MOST_DRAWS):
        shape = draw_shape(rng, family)
        if sum(len(part.faces) for part in shape.parts) > LIMITS.triangles:
            continue
        solid = Solid.of(shape.parts)
        density = rng.uniform(*LIMITS.density)
        least, most = scale_bounds(solid, density, LIMITS.typical_width[family in COMPOSITE])
        if least < most:
            scale = rng.uniform(least, most)
            mass = density * (solid.volume * scale**3)
            return solid.model(
                object_id=object_id, split=split, families=shape.families, color=color, mass=mass, scale=scale
            )
    raise RuntimeError(f"no {family} within the limits in {_MOST_DRAWS} draws")


def scale_bounds(solid: Solid, density: float, typical_width: Bounds) -> Bounds:
    """Return the least and greatest scale that keep all limits, metres per unit; none does when least > greatest."""
    points = solid.points
    poses = resting_poses(points, np.zeros(3), least=0.02)
    probability = np.array([pose.probability for pose in poses])
    probability /= probability.sum()
    widths, heights = np.array([(pose.width, pose.height) for pose in poses]).T
    narrow, wide = (_quantile(widths, probability, share) for share in (1 - LIMITS.share, LIMITS.share))
    bounds = [
        (value[0] / actual, value[1] / actual)
        for value, actual in (
            (LIMITS.longest, float(np.ptp(points, axis=0).max())),
            (LIMITS.height, _quantile(heights, probability, 1 - LIMITS.share)),
            (LIMITS.width, narrow),
            (LIMITS.width, wide),
            (typical_width, float(probability @ widths)),
        )
    ]
    lightest, heaviest = (math.cbrt(mass / (density * solid.volume)) for mass in LIMITS.mass)
    bounds.append((lightest, heaviest))
    return max(least for least, _ in bounds), min(most for _, most in bounds)


def _quantile(values: Array, probability: Array, share: float) -> float:
    """Return the least value that a random pose stays at or below with a probability of `share` or more."""
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(probability[order]) >= share - 1e-9
    return float(values[order][int(reached.argmax())])
