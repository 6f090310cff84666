"""All settings of a training run: the common ones, and those of its estimator and of its networks.

`complete` makes them of what a user gave: a preset decides whatever was not given.
"""

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from graspq.common.errors import UserError
from graspq.common.options import Settings, flag, setting
from graspq.datasets.loader import DEFAULT_BUFFER_BYTES
from graspq.train.device import Device
from graspq.train.estimator import Estimator, EstimatorSettings
from graspq.train.estimators import ESTIMATORS, estimator_named
from graspq.train.networks import NETWORKS, network_named
from graspq.train.networks.network import NetworkSettings
from graspq.train.recipe import Recipe

Preset = Literal["default", "paper"]
NESTED = ("own", "network_own")
# Options of the command that are no settings.
COMMAND_OPTIONS = frozenset({"preset", "help", "version", "verify_replay"})
# Settings that may differ when a run is resumed: they do not decide what is learned. Of shards the digest is compared.
FREE = frozenset({"shards", "out", "save_every", "device", "precision", "resident", "threads"})


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainSettings(Recipe):
    """Complete settings of `grasp-train`; each field's help says what it is.

    `own` are the options of the estimator, `network_own` those of the networks.
    """

    algo: str = setting(help="Estimator, see below, or module:row of your own, whose code is run.", metavar="NAME")
    shards: tuple[str, ...] = setting(help="Dataset folders, shard files or globs; several may follow.")
    out: Path | None = setting(None, help="Run folder; runs/ALGO-DATASET-seedSEED where it is not given.")
    seed: int = setting(0, help="Seed of weights, sample order, augmentation and candidates.", minimum=0)
    validation_fraction: float = setting(
        0.05, help="Part of the blocks held back for validation, 0 to below 1.", minimum=0, maximum=0.9
    )
    save_every: int = setting(500, help="Steps between checkpoints, each with a validation.", minimum=1)
    buffer_bytes: int = setting(
        DEFAULT_BUFFER_BYTES, help="Memory for decoded data, bytes; a dataset that fits is read once.", minimum=1
    )
    device: Device = setting("auto", help="Where to train; auto takes a GPU if there is one.")
    resident: bool = setting(False, help="Keep all images as uint8 on the device, instead of streaming them.")
    threads: int | None = setting(
        None, help="CPU threads of torch; its own choice where not given.", minimum=1, maximum=1024
    )
    own: EstimatorSettings
    network_own: NetworkSettings

    def __post_init__(self) -> None:
        """Check all values.

        Raises:
            UserError: a value is unknown or out of range.
        """
        super().__post_init__()
        if not self.shards:
            raise UserError("--shards: expected dataset folders, shard files or globs, got none")

    @property
    def estimator(self) -> Estimator[Any]:
        """The estimator."""
        return estimator_named(self.algo)

    @property
    def run_folder(self) -> Path:
        """The run folder: `out`, or its default."""
        if self.out is not None:
            return self.out
        path = Path(self.shards[0])
        named = path.parent.parent if path.suffix == ".parquet" else path
        dataset = re.sub(r"[^A-Za-z0-9._-]+", "-", named.absolute().name).strip("-") or "data"
        return Path("runs") / f"{self.algo.replace(':', '-')}-{dataset}-seed{self.seed}"

    def to_json(self) -> dict[str, Any]:
        """Return the settings as plain JSON values, those of estimator and networks in objects of their own."""
        return super().to_json() | {name: getattr(self, name).to_json() for name in NESTED}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "TrainSettings":
        """Return the settings that `to_json` wrote.

        Raises:
            UserError: a name is unknown or a value is out of range.
        """
        # Runs from before there were these settings took every step once, in its own colours.
        before = {"last_step_weight": 1, "color": 0.0}
        flat = before | {name: value for name, value in values.items() if name not in NESTED}
        own = estimator_named(flat["algo"]).settings.from_json(values["own"])
        network_own = network_named(flat["network"]).settings.from_json(values["network_own"])
        return super().from_json(flat | {"own": own, "network_own": network_own})


def complete(given: Mapping[str, Any], preset: Preset = "default") -> TrainSettings:
    """Return complete settings: a preset's values wherever an option was not given.

    Args:
        given: options by name: common ones, the estimator's and the networks'; `algo` and `shards` at least.
        preset: decides the rest: our own, or the paper's.

    Raises:
        UserError: an option is unknown or belongs to another estimator or network, or a value is out of range.
    """
    if "algo" not in given:
        raise UserError(f"--algo: expected an estimator: {', '.join(ESTIMATORS)}, or module:row of your own")
    estimator = estimator_named(given["algo"])
    recipe = estimator.recipe_of(preset)
    network = given.get("network", recipe.network)
    own, network_own = estimator.paper if preset == "paper" else estimator.settings(), network_named(network).settings()
    refuse_taken_names(given["algo"], network)
    values: dict[str, Any] = {field.name: getattr(recipe, field.name) for field in dataclasses.fields(recipe)}
    return _changed(values | {"network": network}, {"own": own, "network_own": network_own}, given)


def with_options(settings: TrainSettings, given: Mapping[str, Any]) -> TrainSettings:
    """Return settings with some options changed: common ones, the estimator's and the networks', but not which.

    Raises:
        UserError: an option is unknown or belongs to another estimator or network, or a value is out of range.
    """
    values = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings)}
    kinds = {name: values.pop(name) for name in NESTED}
    return _changed(values, kinds, given)


def _changed(values: dict[str, Any], kinds: Mapping[str, Settings], given: Mapping[str, Any]) -> TrainSettings:
    places = {field.name: place for place, kind in kinds.items() for field in dataclasses.fields(kind)}
    common = {field.name for field in dataclasses.fields(TrainSettings)} - set(NESTED)
    changed: dict[str, dict[str, Any]] = {place: {} for place in kinds}
    for name, value in given.items():
        if name in common:
            values[name] = value
        elif name in places:
            changed[places[name]][name] = value
        else:
            raise UserError(unknown_option(flag(name), given.get("algo", values.get("algo")), values["network"]))
    replaced = {place: dataclasses.replace(kind, **changed[place]) for place, kind in kinds.items()}
    return TrainSettings(**values | replaced)


def unknown_option(option: str, algo: str, network: str) -> str:
    """Return what to say of an option that neither the common ones, the estimator nor the networks have."""
    name = option.removeprefix("--no-").removeprefix("--").replace("-", "_")
    owners = [f"--algo {row}" for row, one in ESTIMATORS.items() if name in names_of(one.settings)]
    owners += [f"--network {row}" for row, one in NETWORKS.items() if name in names_of(one.settings)]
    if not owners:
        return f"No such option: {option} (with --algo {algo} and --network {network})"
    return f"{option} belongs to {', '.join(owners)}; it is no option of --algo {algo} with --network {network}"


def refuse_taken_names(algo: str, network: str) -> None:
    """Refuse an estimator or networks whose options have a name that another option has.

    Raises:
        UserError: they have.
    """
    estimator, of_network = estimator_named(algo), network_named(network).settings
    own, paper = estimator.settings, type(estimator.paper)
    if not issubclass(paper, own):
        raise UserError(f"--algo {algo}: paper: expected {own.__name__}, got {paper.__name__}")
    of_command, of_networks = names_of(TrainSettings) | COMMAND_OPTIONS, names_of(of_network)
    for option, kind, taken, owner in (
        (f"--algo {algo}", own, of_command, "a common option"),
        (f"--network {network}", of_network, of_command, "a common option"),
        (f"--algo {algo}", own, of_networks, f"an option of --network {network}"),
    ):
        for name in sorted(names_of(kind) & taken):
            raise UserError(f"{option}: {kind.__name__}.{name} is the name of {owner}; give it another")


def names_of(kind: type[Settings]) -> set[str]:
    """Return the names of the settings of a kind."""
    return {field.name for field in dataclasses.fields(kind)}
