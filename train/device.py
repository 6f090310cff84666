"""Which device and arithmetic a run uses."""

import contextlib
import ctypes
import dataclasses
import os
from typing import Literal

import torch

from graspq.common.errors import UserError
from graspq.common.files import cache_folder

Device = Literal["auto", "cpu", "cuda"]


def chosen_device(name: Device) -> torch.device:
    """Return a device by its name; `auto` takes a GPU if there is one.

    Raises:
        UserError: a GPU was asked for and there is none.
    """
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise UserError("device: cuda was asked for but torch sees no GPU; use cpu or auto")
    return torch.device("cuda" if name != "cpu" and available else "cpu")


@dataclasses.dataclass(frozen=True)
class Precision:
    """The arithmetic of the networks on a device; weights, optimiser and losses are float32 always."""

    name: Literal["float32", "bfloat16"]
    device: torch.device

    def autocast(self) -> contextlib.AbstractContextManager[object]:
        """Return the context manager under which networks run."""
        if self.name == "float32":
            return contextlib.nullcontext()
        return torch.autocast(self.device.type, torch.bfloat16)


def chosen_precision(name: Literal["auto", "float32", "bfloat16"], device: torch.device) -> Precision:
    """Return the precision of `--precision`; `auto` is bfloat16 where the device has instructions for it.

    Without them a CPU emulates bfloat16, hundreds of times slower than float32.
    """
    if name != "auto":
        return Precision(name, device)
    if device.type == "cuda":
        native = torch.cuda.is_bf16_supported()
    else:
        able = torch.cpu.get_capabilities()
        native = bool(able.get("avx512_bf16") or able.get("amx_bf16"))
    return Precision("bfloat16" if native else "float32", device)


def prepare(threads: int | None) -> None:
    """Set the number of threads, and keep freed memory in the process instead of giving it back after every step.

    Activations are freed and allocated anew in every step: handing their pages back to the system, which zeroes each
    of them again, cost 15 % of a step. Freed pieces of up to 32 MiB are kept; without effect where it is not glibc.
    """
    if threads is not None:
        torch.set_num_threads(threads)
    torch.backends.cudnn.deterministic = True
    # An optimiser makes this folder, though nothing is compiled: not among the temporary files, where it would stay.
    os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(cache_folder("torchinductor")))
    trim_threshold, top_pad, mmap_threshold = -1, -2, -3
    with contextlib.suppress(OSError, AttributeError):
        library = ctypes.CDLL(None)
        library.mallopt(mmap_threshold, 32 * 2**20)
        library.mallopt(trim_threshold, 2**31 - 1)
        library.mallopt(top_pad, 64 * 2**20)
