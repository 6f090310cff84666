"""The object set of the targeted task: a purple cross to pick, four fixed distractors, twice four unseen ones.

Source: Quillen et al. 2018, section IV: a cross-shaped target among other objects in a cluttered bin.
"""

from collections.abc import Iterator
from pathlib import Path

from graspq.common.errors import UserError
from graspq.common.seeding import generator
from graspq.objects.model import Color, ObjectModel, Solid
from graspq.objects.object_set import ObjectSet
from graspq.objects.procedural import GENERATOR_VERSION, draw_object
from graspq.objects.shapes import cuboid
from graspq.objects.writing import write_object_set

TARGET = "cross"
PURPLE: Color = (0.56, 0.12, 0.86, 1.0)
_CROSS_LENGTH, _CROSS_WIDTH, _CROSS_DENSITY = 0.085, 0.026, 500.0

# Main family and colour of each distractor; its proportions come from the seed. No hue is near the target's.
_DISTRACTORS: dict[str, tuple[tuple[str, Color], ...]] = {
    "distractor": (
        ("cylinder", (0.92, 0.24, 0.20, 1.0)),
        ("bracket", (0.20, 0.66, 0.32, 1.0)),
        ("superquadric", (0.98, 0.78, 0.12, 1.0)),
        ("prism", (0.16, 0.50, 0.92, 1.0)),
    ),
    "test-distractor": (
        ("frustum", (0.98, 0.55, 0.10, 1.0)),
        ("ring", (0.10, 0.74, 0.76, 1.0)),
        ("stone", (0.62, 0.82, 0.16, 1.0)),
        ("box", (0.88, 0.42, 0.38, 1.0)),
    ),
    "validation-distractor": (
        ("lathe", (0.86, 0.20, 0.28, 1.0)),
        ("loft", (0.30, 0.60, 0.80, 1.0)),
        ("bar", (0.80, 0.70, 0.40, 1.0)),
        ("cluster", (0.24, 0.52, 0.30, 1.0)),
    ),
}


def make_targeted(folder: Path | str, *, seed: int) -> ObjectSet:
    """Make the set of the targeted task and return it.

    Splits: "target" holds the `cross`, "distractor" the four fixed ones, "test-distractor" and "validation-distractor"
    four unseen ones each.

    Args:
        folder: where; missing, empty, or the same set already.
        seed: whole number ≥ 0; shapes of the distractors.

    Raises:
        UserError: the seed is negative, or the folder holds something else.
    """
    if seed < 0:
        raise UserError(f"--seed: expected a whole number of at least 0, got {seed}")
    return write_object_set(
        Path(folder), _models(seed), name="targeted", generator_version=GENERATOR_VERSION, seed=seed
    )


def cross() -> ObjectModel:
    """Return the target: two bars of 8.5 × 2.6 × 2.6 cm that cross at right angles, purple."""
    length, width = _CROSS_LENGTH, _CROSS_WIDTH
    solid = Solid.of([cuboid((length, width, width)), cuboid((width, length, width))])
    return solid.model(
        object_id=TARGET, split="target", families=("cross",), color=PURPLE, mass=_CROSS_DENSITY * solid.volume
    )


def _models(seed: int) -> Iterator[ObjectModel]:
    yield cross()
    for key, (split, distractors) in enumerate(_DISTRACTORS.items()):
        for index, (family, color) in enumerate(distractors):
            rng = generator("objects/targeted", seed, key, index)
            yield draw_object(rng, family, object_id=f"{split}_{index}", split=split, color=color)
