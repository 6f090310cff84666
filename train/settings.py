"""All settings of a training run, and the presets that give groups of them their values at once.

`TrainSettings` is complete; `TrainOptions` is what a command line gives, where None means that the preset decides.
"""

import dataclasses
import re
import typing
from pathlib import Path
from typing import Any, Literal

from graspq.common.errors import UserError
from graspq.common.options import Settings, flag, parse_count, setting
from graspq.datasets.loader import DEFAULT_BUFFER_BYTES
from graspq.train.estimators import ESTIMATORS, estimator_named
from graspq.train.updates import LossName

PresetName = Literal["default", "paper"]

PRESETS: dict[PresetName, dict[str, Any]] = {
    "default": {
        "steps": 3_000,
        "network": "default",
        "loss": "cross-entropy",
        "batch_size": 256,
        "learning_rate": 2e-3,
        "weight_decay": 0.02,
        "schedule": "cosine",
        "warmup": 0.1,
        "average_decay": 0.999,
        "shift": 4,
        "mirror": True,
        "jitter": 0.0,
        "action_noise": 0.0,
        "anneal": 1.0,
        "centred": True,
        "actor_rest": 0.2,
        "actor_rate": 0.1,
        "actor_every": 2,
        "path_steps": None,
        "penalty": None,
        "lag_steps": 50,
        "precision": "auto",
    },
    # Source: the paper's text, and where it is silent its released code (`env_procedural` and `get_data`).
    "paper": {
        "steps": 2_000_000,
        "network": "paper",
        "loss": "squared",
        "batch_size": 32,
        "learning_rate": 1e-3,
        "weight_decay": 0.0,
        "schedule": "constant",
        "warmup": 0.0,
        "average_decay": 0.0,
        "shift": 0,
        "mirror": False,
        "jitter": 0.0,
        "action_noise": 0.0,
        "anneal": 0.05,
        "centred": False,
        "actor_rest": 0.0,
        "actor_rate": 1.0,
        "actor_every": 1,
        "path_steps": 10,
        "penalty": 3.0,
        "lag_steps": 50,
        "precision": "float32",
    },
}
# Where the authors' code has settings of its own for an estimator, and the paper does not say otherwise.
PAPER_BY_ALGO: dict[str, dict[str, Any]] = {
    "corr-mc": {"learning_rate": 1e-4, "lag_steps": 100},
    "pcl": {"learning_rate": 1e-4, "batch_size": 64, "discount": 0.95},
}


def preset_values(preset: PresetName, algo: str) -> dict[str, Any]:
    """Return what a preset gives an estimator."""
    return PRESETS[preset] | (PAPER_BY_ALGO.get(algo, {}) if preset == "paper" else {})


def _preset_setting(name: str, *, help: str, **more: Any) -> Any:
    values = {preset: PRESETS[preset][name] for preset in PRESETS}
    shown = "; ".join(f"{preset}: {value}" for preset, value in values.items())
    return setting(values["default"], help=f"{help} [{shown}]", **more)


def _listed(values: dict[str, Any]) -> str:
    return ", ".join(f"{flag(name)} {value}" for name, value in values.items())


def _algorithm(text: str) -> str:
    estimator_named(text)
    return text


@dataclasses.dataclass(frozen=True)
class TrainSettings(Settings):
    """Settings of `grasp-train`; each field's help says what it is."""

    algo: str = setting(
        help="Estimator: " + "; ".join(f"{name}: {row.summary}" for name, row in ESTIMATORS.items()) + ".",
        parse=_algorithm,
        metavar="|".join(ESTIMATORS),
    )
    shards: tuple[str, ...] = setting(help="Dataset folders, shard files or globs; several may follow.")
    out: Path | None = setting(None, help="Run folder; runs/ALGO-DATASET-seedSEED where it is not given.")
    seed: int = setting(0, help="Seed of weights, sample order, augmentation and candidates.", minimum=0)
    preset: PresetName = setting(
        "default",
        help="Values of all options marked with two values in brackets; paper has some of its own for "
        + "; ".join(f"{algo}: {_listed(values)}" for algo, values in PAPER_BY_ALGO.items())
        + ".",
    )
    steps: int = _preset_setting("steps", help="Gradient steps, such as 8000 or 8k.", minimum=1, parse=parse_count)
    network: Literal["default", "paper"] = _preset_setting("network", help="Q-network.")
    width: int = setting(32, help="Channels and units of the paper's network.", minimum=1)
    loss: LossName = _preset_setting("loss", help="Loss between Q and target; pcl has its own.")  # noqa: RUF009
    batch_size: int = _preset_setting("batch_size", help="Transitions of a gradient step.", minimum=2)
    learning_rate: float = _preset_setting("learning_rate", help="Highest learning rate of AdamW.", minimum=0)
    weight_decay: float = _preset_setting(
        "weight_decay", help="Decoupled weight decay of matrices and filters; 0 is Adam.", minimum=0
    )
    schedule: Literal["cosine", "constant"] = _preset_setting(
        "schedule", help="Learning rate after warming up: cosine falls to 0 at the last step."
    )
    warmup: float = _preset_setting(
        "warmup", help="Part of the steps in which the learning rate rises linearly, 0 to 1.", minimum=0, maximum=1
    )
    average_decay: float = _preset_setting(
        "average_decay",
        help="Decay of the moving average of weights that policies use, below 1; 0 uses the weights themselves.",
        minimum=0,
        maximum=0.999999,
    )
    shift: int = _preset_setting("shift", help="Largest random shift of images, pixels.", minimum=0, maximum=32)
    mirror: bool = _preset_setting(
        "mirror",
        help="Mirror half of each batch about the scene's plane of symmetry; corr-mc and blend look into it too.",
    )
    jitter: float = _preset_setting(
        "jitter", help="Largest random relative change of contrast and brightness.", minimum=0, maximum=1
    )
    action_noise: float = _preset_setting(
        "action_noise", help="Standard deviation of noise on logged actions, in units of the limits.", minimum=0
    )
    anneal: float = _preset_setting(
        "anneal",
        help="Part of the steps over which the correction of corr-mc rises from 0 to 1; 0: all at once.",
        minimum=0,
        maximum=1,
    )
    centred: bool = _preset_setting(
        "centred",
        help="Shift the advantages of corr-mc and blend so that their targets agree with the lagged Q on average.",
    )
    actor_rest: float = _preset_setting(
        "actor_rest",
        help="Part of the steps in which ddpg's actor stays as it began, while Q learns.",
        minimum=0,
        maximum=1,
    )
    actor_rate: float = _preset_setting(
        "actor_rate", help="Learning rate of the actor of ddpg and pcl over that of Q or V.", minimum=0, maximum=10
    )
    actor_every: int = _preset_setting(
        "actor_every", help="Steps of ddpg's Q from one step of its actor to the next.", minimum=1
    )
    path_steps: int | None = _preset_setting(
        "path_steps", help="Steps d of a path of pcl; the rest of the episode where it is not given.", minimum=1
    )
    penalty: float | None = _preset_setting(
        "penalty",
        help="Weight of pcl's relative entropy to the lagged policy; tuned to --kl-bound where it is not given.",
        minimum=1e-6,
    )
    kl_bound: float = setting(
        0.02, help="Mean relative entropy to the lagged policy that pcl's weight is tuned to, nats.", minimum=1e-6
    )
    discount: float | None = setting(
        None,
        help="Discount, 0 to 1. Default: 0.9, but the data's own for mc; supervised has none and takes none.",
        minimum=0,
        maximum=1,
    )
    lag_steps: int = _preset_setting(
        "lag_steps", help="Steps between copies of the weights into the lagged network.", minimum=1
    )
    candidates: int = setting(16, help="Uniform actions among which a target looks for the best.", minimum=1)
    validation_fraction: float = setting(
        0.05, help="Part of the blocks held back for validation, 0 to below 1.", minimum=0, maximum=0.9
    )
    validation_transitions: int = setting(8192, help="Most held-back transitions of a validation.", minimum=1)
    validate_every: int = setting(500, help="Steps between validations.", minimum=1)
    checkpoint_every: int = setting(500, help="Steps between checkpoints.", minimum=1)
    keep_checkpoints: int = setting(3, help="How many of the newest checkpoints are kept.", minimum=1)
    log_every: int = setting(50, help="Steps between rows of metrics.jsonl.", minimum=1)
    buffer_bytes: int = setting(
        DEFAULT_BUFFER_BYTES,
        help="Memory for decoded data, bytes; a dataset that fits is read once.",
        minimum=1,
    )
    device: Literal["auto", "cpu", "cuda"] = setting("auto", help="Where to train; auto takes a GPU if there is one.")
    precision: Literal["auto", "float32", "bfloat16"] = _preset_setting(
        "precision", help="Arithmetic of the networks; auto tries both at the start and takes the faster right one."
    )
    resident: Literal["auto", "yes", "no"] = setting(
        "auto",
        help="Keep all images as uint8 on the device, instead of streaming them; the batches are the same. auto: on a "
        "GPU where they fit into 60 % of its free memory.",
    )
    compile: Literal["auto", "yes", "no"] = setting(
        "auto",
        help="torch.compile for the networks. auto tries it on a GPU at the start, and takes it where it is faster and "
        "right; on a CPU it is off: there it took a minute of compiling and was then no faster.",
    )
    threads: int | None = setting(None, help="CPU threads of torch; its own choice where not given.", minimum=1)

    def __post_init__(self) -> None:
        """Check all values.

        Raises:
            UserError: a value is unknown or out of range.
        """
        super().__post_init__()
        estimator_named(self.algo)
        if not self.shards:
            raise UserError("--shards: expected dataset folders, shard files or globs, got none")

    @property
    def run_folder(self) -> Path:
        """The run folder: `out`, or its default."""
        if self.out is not None:
            return self.out
        path = Path(self.shards[0])
        named = path.parent.parent if path.suffix == ".parquet" else path
        dataset = re.sub(r"[^A-Za-z0-9._-]+", "-", named.absolute().name).strip("-") or "data"
        return Path("runs") / f"{self.algo.replace(':', '-')}-{dataset}-seed{self.seed}"


def _options_type() -> type[Settings]:
    """Return the dataclass of the command line: `TrainSettings` with None where a preset has a value."""
    hints = typing.get_type_hints(TrainSettings)
    fields: list[Any] = []
    for field in dataclasses.fields(TrainSettings):
        governed = field.name in PRESETS["default"]
        hint = hints[field.name] | None if governed else hints[field.name]
        default = None if governed else field.default
        fields.append((field.name, hint, dataclasses.field(default=default, metadata=field.metadata)))
    made: type[Settings] = dataclasses.make_dataclass("TrainOptions", fields, bases=(Settings,), frozen=True)
    return made


TrainOptions = _options_type()


def resolve(options: Settings) -> TrainSettings:
    """Return complete settings: the preset's values wherever an option was not given.

    Args:
        options: `TrainOptions`.

    Raises:
        UserError: a value is unknown or out of range.
    """
    given = {field.name: getattr(options, field.name) for field in dataclasses.fields(options)}
    preset = preset_values(given["preset"], given["algo"])
    values: dict[str, Any] = {name: preset.get(name) if value is None else value for name, value in given.items()}
    return TrainSettings(**values)


def preset_settings(preset: PresetName, **given: Any) -> TrainSettings:
    """Return the settings of a preset with those given on top, as the command line would."""
    return TrainSettings(**preset_values(preset, given["algo"]) | {"preset": preset} | given)
