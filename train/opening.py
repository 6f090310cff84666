"""What is settled before the first step of a session: the run folder, and in which arithmetic the networks run.

What was found by trying at a run's start is kept in its `config.json`, so that it goes on in the same arithmetic.
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from graspq.train.checkpoint import remove_unfinished
from graspq.train.distributed import Ranks
from graspq.train.hardware import Precision, chosen_compilation, chosen_precision
from graspq.train.networks import NetworkSpecification, QNetwork, make_network
from graspq.train.run import Run, Witness
from graspq.train.settings import TrainSettings
from graspq.train.state import seeded


@contextlib.contextmanager
def opened(folder: Path, config: dict[str, Any], ranks: Ranks) -> Iterator[Run]:
    """Open a run's folder; of several ranks the first locks and writes it, and the others look on.

    Args:
        folder: the run's.
        config: the content of a new run's `config.json`.
        ranks: those that train together.

    Raises:
        UserError: the folder is not usable, or holds a run of another configuration.
    """
    with contextlib.ExitStack() as stack:

        def lock() -> Run:
            run = Run.create_or_resume(folder, config)
            stack.enter_context(run.locked())
            remove_unfinished(run.checkpoints_folder)
            return run

        run = ranks.from_first(lock)
        yield run if ranks.first else Witness(run.folder, run.config)


def precision_of(
    run: Run, settings: TrainSettings, specification: NetworkSpecification, device: torch.device
) -> Precision:
    """Return the precision that the run was begun with on such a device, or choose one and note it in the run."""
    known = run.config.get("precision", {})
    if settings.precision == "auto" and known.get("device") == device.type:
        return Precision(known["name"], device, known["probe"])
    chosen = chosen_precision(settings.precision, _probed(specification, device), specification.image_shape)
    run.note("precision", {"name": chosen.name, "device": device.type, "probe": chosen.probe})
    return chosen


def is_compiled(run: Run, settings: TrainSettings, specification: NetworkSpecification, precision: Precision) -> bool:
    """Return whether networks run compiled: as the run was begun with on such a device, or by trying."""
    device, known = precision.device, run.config.get("compile", {})
    if settings.compile == "auto" and known.get("device") == device.type:
        return bool(known["compiled"])
    network = _probed(specification, device)
    compiled, probe = chosen_compilation(settings.compile, network, precision, specification.image_shape)
    run.note("compile", {"compiled": compiled, "device": device.type, "probe": probe})
    return compiled


def _probed(specification: NetworkSpecification, device: torch.device) -> QNetwork:
    return make_network(specification, seeded("train/probe")).to(device)
