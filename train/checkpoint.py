"""Checkpoints: safetensors files and a JSON that names the SHA-256 of each; written whole or not at all, no pickle.

A checkpoint is a folder `step-00000500` with one file for each network and optimiser, and `state.json`.
"""

import dataclasses
import hashlib
import json
import re
from pathlib import Path
from typing import Any

import click
import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor, nn

from graspq.common.checksums import DamagedError
from graspq.common.errors import UserError, said_of
from graspq.common.files import committed_folder, content_of, read_json
from graspq.train.estimators import estimator_named
from graspq.train.networks import build
from graspq.train.networks.network import NetworkSpecification
from graspq.train.run import Run, checkpoint_name, step_of
from graspq.train.state import TrainState

FORMAT = 3
KEPT = "kept"
_PLAIN_FILE = re.compile(r"\w[\w-]*\.safetensors", re.ASCII)
STATE_FILE = "state.json"
REMEDY = "copy it again, or delete this checkpoint's folder to go on from the one before it"


def save_checkpoint(folder: Path, state: TrainState) -> Path:
    """Write `folder/step-NNNNNNNN` durably and return it; after a crash it is there whole or not at all.

    Args:
        folder: the run's `checkpoints`.
        state: all of it is kept.
    """
    final = folder / checkpoint_name(state.step)
    networks = state.networks
    contents = {f"{name}.safetensors": network.state_dict() for name, network in state.named_networks.items()}
    contents |= {
        f"optimizer-{part}.safetensors": _moments(optimizer, networks.online[part])
        for part, optimizer in state.optimizers.items()
    }
    contents[f"{KEPT}.safetensors"] = networks.kept
    with committed_folder(final, replace=True) as temporary:
        files = {name: _write(temporary / name, _packed(tensors)) for name, tensors in contents.items()}
        description = {
            "format": FORMAT,
            "step": state.step,
            "network": networks.specification.to_json(),
            "parts": list(networks.online),
            "files": files,
        }
        described = json.dumps(description | {"digest": _digest(description)}, indent=2) + "\n"
        _write(temporary / STATE_FILE, described.encode())
    return final


def load_checkpoint(checkpoint: Path, state: TrainState) -> None:
    """Fill a freshly made state with a checkpoint's: training goes on as if it had never stopped.

    Raises:
        UserError: the checkpoint is damaged, or of another network.
    """
    description, networks = describe(checkpoint), state.networks
    if description["network"] != networks.specification.to_json():
        raise UserError(
            f"{checkpoint}: of another network: expected {networks.specification.to_json()}, "
            f"got {description['network']}; choose another run folder with --out"
        )
    optimizers = [f"optimizer-{part}" for part in state.optimizers]
    expected = {f"{name}.safetensors" for name in [*state.named_networks, *optimizers, KEPT]}
    if set(description["files"]) != expected:
        raise UserError(f"{checkpoint}: expected {', '.join(sorted(expected))}; choose another run folder with --out")
    for name, network in state.named_networks.items():
        _fill(checkpoint / f"{name}.safetensors", network, read_tensors(checkpoint, description, name))
    for part, optimizer in state.optimizers.items():
        moments = read_tensors(checkpoint, description, f"optimizer-{part}")
        _restore_moments(optimizer, networks.online[part], moments)
    for name, tensor in read_tensors(checkpoint, description, KEPT).items():
        networks.kept[name] = tensor.to(networks.precision.device)
    state.step = int(description["step"])


@dataclasses.dataclass(frozen=True)
class LoadedRun:
    """What acts in a run, ready to act.

    Attributes:
        networks: by part, the averaged networks where the run kept them, else the trained ones; in evaluation mode, on
            the CPU.
        kept: what the estimator kept besides.
        specification: of the networks.
        config: the run's `config.json`.
        step: training step of the checkpoint.
        checkpoint: its folder.
        sha256: of all weights and of `kept`, as one digest.
    """

    networks: dict[str, nn.Module]
    kept: dict[str, Tensor]
    specification: NetworkSpecification
    config: dict[str, Any]
    step: int
    checkpoint: Path
    sha256: str


def load_acting(path: Path | str, step: int | None = None) -> LoadedRun:
    """Return what acts in a run.

    Args:
        path: a run folder, or one of its checkpoints.
        step: training step of the checkpoint; the newest where not given.

    Raises:
        UserError: there is no run or no such checkpoint, or it is damaged or of another network.
    """
    path = Path(path)
    given = (path / STATE_FILE).is_file()
    run = Run.open(path.absolute().parent.parent if given else path)
    checkpoint = path if given and step is None else run.checkpoint(step)
    description = describe(checkpoint)
    with said_of(checkpoint / STATE_FILE):
        specification = NetworkSpecification.from_json(description["network"])
    if run.config.get("network") != description["network"]:
        raise UserError(
            f"{checkpoint}: of another network than its run: config.json says {run.config.get('network')}, "
            f"the checkpoint {description['network']}; copy the run again"
        )
    algo = run.config["settings"].get("algo")
    if not isinstance(algo, str):
        raise UserError(f"{run.folder / 'config.json'}: names no estimator (settings.algo); copy the run again")
    with said_of(run.folder / "config.json"):
        makers = estimator_named(algo).parts
    networks: dict[str, nn.Module] = {}
    names = []
    for part in description["parts"]:
        if part not in makers:
            raise UserError(f"{checkpoint}: has a network {part!r}, which its estimator does not; train again")
        averaged = f"averaged-{part}.safetensors" in description["files"]
        names.append(f"averaged-{part}" if averaged else part)
        network = build(makers[part], specification)
        _fill(checkpoint / f"{names[-1]}.safetensors", network, read_tensors(checkpoint, description, names[-1]))
        networks[part] = network.eval().requires_grad_(False)
    kept = read_tensors(checkpoint, description, KEPT)
    digests = {name: description["files"][f"{name}.safetensors"] for name in [*names, KEPT]}
    return LoadedRun(
        networks=networks,
        kept=kept,
        specification=specification,
        config=run.config,
        step=int(description["step"]),
        checkpoint=checkpoint,
        sha256=_digest(digests),
    )


def newest_whole(run: Run) -> Path | None:
    """Return a run's newest checkpoint that is whole, or None before the first; says which newer ones are damaged.

    Raises:
        DamagedError: there are checkpoints, and none is whole.
    """
    damaged: DamagedError | None = None
    for checkpoint in reversed(run.checkpoints()):
        try:
            description = describe(checkpoint)
            for file in description["files"]:
                _read(checkpoint / file, description)
        except DamagedError as error:
            click.echo(f"{error.message.partition('; ')[0]}; going on from the checkpoint before it", err=True)
            damaged = damaged or error
            continue
        return checkpoint
    if damaged is not None:
        raise DamagedError(f"{run.folder}: no checkpoint is whole; copy one again, or train again with another --out")
    return None


def describe(checkpoint: Path) -> dict[str, Any]:
    """Return a checkpoint's `state.json`.

    Raises:
        UserError: it is of another format, or the folder was renamed.
        DamagedError: it is missing or damaged.
    """
    path = checkpoint / STATE_FILE
    try:
        found = read_json(path, "checkpoint")
    except UserError as error:
        raise DamagedError(f"{error.message}; {REMEDY}") from None
    description: dict[str, Any] = found if isinstance(found, dict) else {}
    if description.pop("digest", None) != _digest(description):
        raise DamagedError(f"{path}: damaged, its digest does not fit; {REMEDY}")
    if description.get("format") != FORMAT:
        raise UserError(f"{path}: expected a checkpoint of format {FORMAT}; train again")
    _check_description(path, description)
    if step_of(checkpoint) not in (None, description["step"]):
        raise UserError(f"{checkpoint}: holds step {description['step']}; give the folder its own name again")
    return description


def _check_description(path: Path, description: dict[str, Any]) -> None:
    """Refuse a `state.json` that is whole and was not written by us; a checkpoint names no files but its own."""
    kinds = {"step": int, "network": dict, "parts": list, "files": dict}
    if (
        any(type(description.get(name)) is not kind for name, kind in kinds.items())
        or not description["parts"]
        or not all(isinstance(part, str) for part in description["parts"])
        or not all(_PLAIN_FILE.fullmatch(name) for name in description["files"])
    ):
        raise UserError(f"{path}: not the description of a checkpoint; train again")


def read_tensors(checkpoint: Path, description: dict[str, Any], name: str) -> dict[str, Tensor]:
    """Return the tensors of one file of a checkpoint after checking its SHA-256.

    Raises:
        DamagedError: the file is missing or damaged.
    """
    path = checkpoint / f"{name}.safetensors"
    try:
        return safetensors.torch.load(_read(path, description))
    except SafetensorError as error:
        raise DamagedError(f"{path}: no safetensors file ({error}); {REMEDY}") from None


def _read(path: Path, description: dict[str, Any]) -> bytes:
    """Return a file of a checkpoint after checking its SHA-256."""
    try:
        content = content_of(path)
    except OSError as error:
        raise DamagedError(f"{path}: cannot be read ({error.strerror}); {REMEDY}") from None
    if hashlib.sha256(content).hexdigest() != description["files"].get(path.name):
        raise DamagedError(f"{path}: damaged, its SHA-256 is not that of {STATE_FILE}; {REMEDY}")
    return content


def _packed(tensors: dict[str, Tensor]) -> bytes:
    # Contiguous: safetensors knows no memory format; the layout is the network's, and is restored on loading.
    return safetensors.torch.save({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()})


def _write(path: Path, content: bytes) -> str:
    path.write_bytes(content)
    return hashlib.sha256(content).hexdigest()


def _digest(description: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()


def _fill(path: Path, network: nn.Module, tensors: dict[str, Tensor]) -> None:
    expected = {name: list(tensor.shape) for name, tensor in network.state_dict().items()}
    found = {name: list(tensor.shape) for name, tensor in tensors.items()}
    kinds = {name: tensor.dtype for name, tensor in network.state_dict().items()}
    if found != expected:
        wrong = min(name for name in expected.keys() | found.keys() if expected.get(name) != found.get(name))
        raise UserError(
            f"{path}: of another network: {wrong} should be {expected.get(wrong, 'absent')}, "
            f"is {found.get(wrong, 'absent')}; use a checkpoint of this network"
        )
    other = next((name for name, tensor in tensors.items() if tensor.dtype != kinds[name]), None)
    if other is not None:
        raise UserError(f"{path}: {other} should be {kinds[other]}, is {tensors[other].dtype}; use another checkpoint")
    broken = next((name for name, tensor in tensors.items() if not bool(torch.isfinite(tensor).all())), None)
    if broken is not None:
        raise UserError(f"{path}: {broken} is not finite; use another checkpoint")
    network.load_state_dict(tensors)


def _moments(optimizer: torch.optim.Optimizer, network: nn.Module) -> dict[str, Tensor]:
    """Return the optimiser's tensors, named `exp_avg/head.weight` and so on."""
    return {
        f"{key}/{name}": value
        for name, parameter in network.named_parameters()
        for key, value in optimizer.state.get(parameter, {}).items()
    }


def _restore_moments(optimizer: torch.optim.Optimizer, network: nn.Module, tensors: dict[str, Tensor]) -> None:
    parameters = dict(network.named_parameters())
    for label, tensor in tensors.items():
        key, name = label.split("/", 1)
        if name not in parameters or (tensor.dim() > 0 and tensor.shape != parameters[name].shape):
            raise UserError(f"optimiser state {label}: of another network; choose another run folder with --out")
        parameter = parameters[name]
        # The moments lie in memory as the weights do; a step counter is a scalar.
        restored = torch.empty_like(parameter, requires_grad=False) if tensor.dim() > 0 else torch.empty_like(tensor)
        optimizer.state[parameter][key] = restored.to(parameter.device).copy_(tensor)
