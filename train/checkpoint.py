"""Checkpoints: safetensors files and a JSON that names the SHA-256 of each; written whole or not at all, no pickle.

A checkpoint is a folder `step-00000500` with one file for each network and optimiser, and `state.json`.
"""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor, nn

from graspq.common.errors import UserError
from graspq.common.files import committed_folder, read_json
from graspq.train.estimators import estimator_named
from graspq.train.networks import build
from graspq.train.networks.network import NetworkSpecification
from graspq.train.run import Run, checkpoint_name, step_of
from graspq.train.state import TrainState

FORMAT = 3
KEPT = "kept"
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
    specification = NetworkSpecification.from_json(description["network"])
    if run.config.get("network") != description["network"]:
        raise UserError(
            f"{checkpoint}: of another network than its run: config.json says {run.config.get('network')}, "
            f"the checkpoint {description['network']}; copy the run again"
        )
    makers = estimator_named(run.config["settings"]["algo"]).parts
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
    digests = {name: description["files"][f"{name}.safetensors"] for name in [*names, KEPT]}
    return LoadedRun(
        networks=networks,
        kept=read_tensors(checkpoint, description, KEPT),
        specification=specification,
        config=run.config,
        step=int(description["step"]),
        checkpoint=checkpoint,
        sha256=_digest(digests),
    )


def describe(checkpoint: Path) -> dict[str, Any]:
    """Return a checkpoint's `state.json`.

    Raises:
        UserError: it is missing or damaged, or the folder was renamed.
    """
    description = read_json(checkpoint / STATE_FILE, "checkpoint")
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        raise UserError(f"{checkpoint / STATE_FILE}: expected a checkpoint of format {FORMAT}; train again")
    if description.pop("digest", None) != _digest(description):
        raise UserError(f"{checkpoint / STATE_FILE}: damaged, its digest does not fit; {REMEDY}")
    if step_of(checkpoint) not in (None, description["step"]):
        raise UserError(f"{checkpoint}: holds step {description['step']}; give the folder its own name again")
    return description


def read_tensors(checkpoint: Path, description: dict[str, Any], name: str) -> dict[str, Tensor]:
    """Return the tensors of one file of a checkpoint after checking its SHA-256.

    Raises:
        UserError: the file is missing or damaged.
    """
    path = checkpoint / f"{name}.safetensors"
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); {REMEDY}") from None
    if hashlib.sha256(content).hexdigest() != description["files"].get(path.name):
        raise UserError(f"{path}: damaged, its SHA-256 is not that of {STATE_FILE}; {REMEDY}")
    try:
        return safetensors.torch.load(content)
    except SafetensorError as error:
        raise UserError(f"{path}: no safetensors file ({error}); {REMEDY}") from None


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
    if found != expected:
        wrong = min(name for name in expected.keys() | found.keys() if expected.get(name) != found.get(name))
        raise UserError(
            f"{path}: of another network: {wrong} should be {expected.get(wrong, 'absent')}, "
            f"is {found.get(wrong, 'absent')}; use a checkpoint of this network"
        )
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
