"""The common recipe of training: what every estimator is trained with unless told otherwise, and the paper's."""

import dataclasses
from typing import Literal, Self

from graspq.common.options import Settings, parse_count, setting

# The default number of steps for that many grasps, in batches of 256; see `Recipe.for_grasps`.
USUAL_STEPS, USUAL_GRASPS = 1_000, 10_000


@dataclasses.dataclass(frozen=True)
class Recipe(Settings):
    """Options that are the same for all estimators and that a preset decides; see each field's help."""

    steps: int | None = setting(
        None,
        help="Gradient steps, such as 8000 or 8k; data: as the amount of data asks, 1,000 for 10,000 grasps.",
        minimum=1,
        parse=parse_count,
        none="data",
    )
    network: str = setting(
        "default", help="Networks: default, paper, or module:network of your own, whose code is run."
    )
    batch_size: int = setting(256, help="Transitions of a gradient step.", minimum=2, maximum=1_000_000)
    learning_rate: float = setting(2e-3, help="Highest learning rate of AdamW.", minimum=0)
    weight_decay: float = setting(0.02, help="Decoupled weight decay of matrices and filters; 0 is Adam.", minimum=0)
    schedule: Literal["cosine", "constant"] = setting(
        "cosine", help="Learning rate after warming up: cosine falls to 0 at the last step."
    )
    warmup: float = setting(
        0.1, help="Part of the steps in which the learning rate rises linearly, 0 to 1.", minimum=0, maximum=1
    )
    average_decay: float = setting(
        0.999,
        help="Decay of the moving average of weights that policies use, below 1; 0 uses the weights themselves.",
        minimum=0,
        maximum=0.999999,
    )
    last_step_weight: int = setting(
        4,
        help="How often an epoch takes the last step of each grasp, the one whose target is the outcome itself; all "
        "others once. In whole episodes, how much its loss weighs.",
        minimum=1,
        maximum=1000,
    )
    shift: int = setting(4, help="Largest random shift of images, pixels.", minimum=0, maximum=32)
    mirror: bool = setting(True, help="Mirror half of each batch, where the data's action space has a mirror.")
    color: float = setting(
        0.3,
        help="Change colours at random: exchange channels, scale each by up to this part, shift it by up to this times "
        "60 grey levels; 0: never.",
        minimum=0,
        maximum=1,
    )
    precision: Literal["auto", "float32", "bfloat16"] = setting(
        "auto", help="Arithmetic of the networks; auto: bfloat16 on hardware that has instructions for it."
    )

    def for_grasps(self, count: int) -> Self:
        """Return the recipe with the number of steps for that many grasps, unless it has one.

            steps = 1,000 · (count / 10,000)^⅔ · 256 / batch size,  to the next ten

        More data are worth more steps, and fewer passes. Measurements: docs/networks.md.
        """
        if self.steps is not None:
            return self
        steps = USUAL_STEPS * (count / USUAL_GRASPS) ** (2 / 3) * 256 / self.batch_size
        return dataclasses.replace(self, steps=max(round(steps / 10), 1) * 10)

    @property
    def last_step(self) -> int:
        """The number of steps; `for_grasps` must have set it."""
        if self.steps is None:
            raise ValueError("steps: the data have not decided them yet; call for_grasps")
        return self.steps


DEFAULT = Recipe()

# Source: the released code of the paper (`env_procedural` and `get_data`), and its text where there is no code.
PAPER = Recipe(
    steps=2_000_000,
    network="paper",
    batch_size=32,
    learning_rate=1e-3,
    weight_decay=0.0,
    schedule="constant",
    warmup=0.0,
    average_decay=0.0,
    last_step_weight=1,
    shift=0,
    mirror=False,
    color=0.0,
    precision="float32",
)
