"""Which device and arithmetic a run uses: chosen once, at its start, by trying.

bfloat16 is several times faster where a CPU has instructions for it and hundreds of times slower where it has not.
"""

import contextlib
import copy
import ctypes
import dataclasses
import functools
import time
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import nn

from graspq.common.errors import UserError
from graspq.train.networks import QNetwork

if TYPE_CHECKING:
    from graspq.train.settings import TrainSettings

PrecisionName = Literal["float32", "bfloat16"]
PROBE_BATCH = 64
# Correct bfloat16 gives about 0.1, an unrelated output 1.4.
TOLERANCE = 0.3
# Compiled code adds up in another order and may keep bfloat16 sums in float32.
COMPILED_TOLERANCE = {"float32": 0.01, "bfloat16": TOLERANCE}


def chosen_device(name: Literal["auto", "cpu", "cuda"]) -> torch.device:
    """Return the device of `--device`.

    Raises:
        UserError: a GPU was asked for and there is none.
    """
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise UserError("--device: cuda was asked for but torch sees no GPU; use --device cpu or auto")
    return torch.device("cuda" if name != "cpu" and available else "cpu")


def prepare(settings: "TrainSettings") -> None:
    """Set the number of threads, and keep freed memory in the process instead of giving it back after every step."""
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    torch.backends.cudnn.deterministic = True
    keep_freed_memory()


def keep_freed_memory() -> None:
    """Ask the C library to reuse freed memory of up to 32 MiB a piece; without effect where it is not glibc.

    Activations are freed and allocated anew in every step: handing their pages back to the system, which zeroes each
    of them again, cost 15 % of a training step.
    """
    trim_threshold, top_pad, mmap_threshold = -1, -2, -3
    with contextlib.suppress(OSError, AttributeError):
        library = ctypes.CDLL(None)
        library.mallopt(mmap_threshold, 32 * 2**20)
        library.mallopt(trim_threshold, 2**31 - 1)
        library.mallopt(top_pad, 64 * 2**20)


@dataclasses.dataclass(frozen=True)
class Precision:
    """The arithmetic of the networks on a device; weights, optimiser and losses are float32 always.

    `probe` says how it was chosen, for `config.json`.
    """

    name: PrecisionName
    device: torch.device
    probe: dict[str, Any] = dataclasses.field(default_factory=dict)

    def autocast(self) -> contextlib.AbstractContextManager[object]:
        """Return the context manager under which networks run."""
        if self.name == "float32":
            return contextlib.nullcontext()
        return torch.autocast(self.device.type, torch.bfloat16)


def chosen_precision(
    name: Literal["auto", "float32", "bfloat16"], network: QNetwork, image_shape: tuple[int, int, int]
) -> Precision:
    """Return the precision of `--precision`; `auto` takes bfloat16 where it is faster and gives the same Q.

    "The same" means that the root of the mean squared difference is at most 0.3 of the outputs' standard deviation over
    states. The network itself is not changed.

    Args:
        name: what was asked for.
        network: on its device.
        image_shape: (H, W, C).
    """
    device = next(network.parameters()).device
    if name != "auto":
        return Precision(name, device, {"asked": name})
    trial = copy.deepcopy(network)
    outputs, seconds = {}, {}
    # Few images first: where bfloat16 is emulated, the full batch would take minutes.
    for batch in (2, PROBE_BATCH):
        for candidate in (Precision("float32", device), Precision("bfloat16", device)):
            outputs[candidate.name], seconds[candidate.name] = _trial(trial, candidate, image_shape, batch)
        if seconds["bfloat16"] > 10 * seconds["float32"]:
            break
    difference = float((outputs["bfloat16"] - outputs["float32"]).square().mean().sqrt())
    # Against how much Q differs between states: at the start Q itself is near 0, and any noise would be small beside 1.
    right = difference <= TOLERANCE * float(outputs["float32"].std())  # false for NaN too
    faster = seconds["bfloat16"] < seconds["float32"]
    probe = {
        "asked": "auto",
        "milliseconds": {key: round(1e3 * value, 2) for key, value in seconds.items()},
        "root_mean_square_difference": difference if right else repr(difference),
        "batch": batch,
    }
    return Precision("bfloat16" if right and faster else "float32", device, probe)


def chosen_compilation(
    name: Literal["auto", "yes", "no"],
    network: QNetwork,
    precision: Precision,
    image_shape: tuple[int, int, int],
    backend: str = "inductor",
) -> tuple[bool, dict[str, Any]]:
    """Return whether to compile networks, and how that was found; `auto` does on a GPU where it is faster and right.

    On a CPU `auto` does not try: measured on one core with the default network, 65 s of compiling and then 139 ms for
    a forward and backward pass of 64 images against 125 ms without. Where compiling fails, as without a
    C++ compiler, `auto` goes on without it. The network itself is not changed.

    Args:
        name: of `--compile`.
        network: on its device.
        precision: its arithmetic.
        image_shape: (H, W, C).
        backend: of `torch.compile`.
    """
    if name != "auto" or precision.device.type != "cuda":
        return name == "yes", {"asked": name}
    return _faster_compiled(network, precision, image_shape, backend)


def _faster_compiled(
    network: QNetwork, precision: Precision, image_shape: tuple[int, int, int], backend: str
) -> tuple[bool, dict[str, Any]]:
    plain, trial = copy.deepcopy(network), copy.deepcopy(network)
    try:
        compile_networks([trial], backend)
        outputs, seconds = _trial(trial, precision, image_shape, PROBE_BATCH)
    # Whatever a compiler stumbles over: the run does not need it.
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        return False, {"asked": "auto", "failed": reason}
    expected, plain_seconds = _trial(plain, precision, image_shape, PROBE_BATCH)
    difference = float((outputs - expected).square().mean().sqrt())
    right = difference <= COMPILED_TOLERANCE[precision.name] * float(expected.std())  # false for NaN too
    milliseconds = {"plain": round(1e3 * plain_seconds, 2), "compiled": round(1e3 * seconds, 2)}
    shown = difference if right else repr(difference)
    probe = {"asked": "auto", "milliseconds": milliseconds, "root_mean_square_difference": shown}
    return right and seconds < plain_seconds, probe


def compile_networks(networks: Iterable[nn.Module], backend: str = "inductor") -> None:
    """Let the networks run compiled; their parameters and the names in `state_dict` stay as they are."""
    for network in networks:
        for method in ("trunk", "head") if isinstance(network, QNetwork) else ("forward",):
            setattr(network, method, torch.compile(getattr(network, method), backend=backend))


def _trial(
    network: QNetwork, precision: Precision, image_shape: tuple[int, int, int], batch: int
) -> tuple[torch.Tensor, float]:
    """Return Q in evaluation mode, and the seconds of a forward and backward pass in training mode, least of three."""
    generator = torch.Generator().manual_seed(0)
    image = torch.randint(0, 256, (batch, *image_shape), dtype=torch.uint8, generator=generator)
    image = image.to(precision.device)
    step = torch.zeros(batch, dtype=torch.int64, device=precision.device)
    action = (torch.rand(batch, 4, generator=generator) * 2 - 1).to(precision.device)
    with torch.no_grad(), precision.autocast():
        outputs = network.eval()(image, step, action).float()
    network.train()
    best = float("inf")
    synchronize = torch.cuda.synchronize if precision.device.type == "cuda" else functools.partial(int, 0)
    for _ in range(3):
        synchronize()
        start = time.perf_counter()
        with precision.autocast():
            loss = network(image, step, action).float().mean()
        loss.backward()
        synchronize()
        best = min(best, time.perf_counter() - start)
    return outputs, best
