"""What an evaluation needs to know of a training run: its network, its task and the object set of its data.

This module alone knows how a run's `config.json` and its datasets say so.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch

from graspq.common.errors import UserError
from graspq.datasets.manifest import MANIFEST_NAME, Manifest
from graspq.evaluate.actor_policy import ActorPolicy
from graspq.evaluate.policies import Policy
from graspq.evaluate.q_policy import QPolicy, SyntheticPolicy
from graspq.evaluate.settings import CemSettings, Device
from graspq.sim.task import task_from_json
from graspq.train.checkpoint import STATE_FILE, LoadedRun, load_acting
from graspq.train.estimators import estimator_named
from graspq.train.networks import QNetwork


@dataclass(frozen=True)
class RunFacts:
    """What a run's folder says.

    Attributes:
        algo: the estimator.
        step: training step of the checkpoint.
        network_sha256: of the weights that act.
        task: settings of the task that the data were collected on, as JSON.
        datasets: folders of its datasets that are still there.
        object_set: SHA-256 of the object set that the data were made with; None where the data are gone.
        image_shape: (H, W, 3) that the network sees.
        action_limits: what an action of 1 meant in the data; metres and radians.
        steps: most steps of an episode in the data.
    """

    algo: str
    step: int
    network_sha256: str
    task: dict[str, Any]
    datasets: tuple[Path, ...]
    object_set: str | None
    image_shape: tuple[int, ...]
    action_limits: tuple[float, ...]
    steps: int


def load_run(path: Path, checkpoint: int | None, cem: CemSettings, device: Device) -> tuple[Policy, RunFacts]:
    """Load a run into a policy.

    Args:
        path: the run's folder.
        checkpoint: training step; None for the last.
        cem: settings of the search.
        device: where the network runs.

    Raises:
        UserError: there is no run, no such checkpoint, or it is damaged.
    """
    if (path / STATE_FILE).is_file():
        raise UserError(f"{path}: a checkpoint, expected its run; name {path.parent.parent} with --checkpoint STEP")
    loaded = load_acting(path, checkpoint)
    try:
        dataset, settings = loaded.config["dataset"], loaded.config["settings"]
        folders = tuple(_datasets(settings["shards"]))
        facts = RunFacts(
            algo=str(settings["algo"]),
            step=loaded.step,
            network_sha256=loaded.sha256,
            task=dict(dataset["task"]),
            datasets=folders,
            object_set=dataset.get("object_set", {}).get("sha256") or _object_set(folders),
            image_shape=loaded.specification.image_shape,
            action_limits=tuple(dataset["action_limits"]),
            steps=loaded.specification.steps,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path / 'config.json'}: not the configuration of a training run ({error!r})") from None
    return _policy(loaded, facts, cem, _chosen(device)), facts


def _policy(loaded: LoadedRun, facts: RunFacts, cem: CemSettings, device: torch.device) -> Policy:
    """Return the policy that the run's estimator asks for."""
    acting = estimator_named(facts.algo).acting
    if acting == "actor":
        return ActorPolicy(loaded.networks, device)
    if acting == "synthetic search":
        task = task_from_json(facts.task).settings
        return SyntheticPolicy(cast(QNetwork, loaded.networks["q"]), cem, device, loaded.extra, task)
    return QPolicy(cast(QNetwork, loaded.networks["q"]), cem, device)


def _chosen(device: Device) -> torch.device:
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("--device cuda: PyTorch finds no GPU here; use --device cpu")
    return torch.device("cuda" if device != "cpu" and torch.cuda.is_available() else "cpu")


def _datasets(shards: list[str]) -> Iterator[Path]:
    """Yield the dataset folders that folders, shard files and globs of either belong to, as far as they are there."""
    seen = set()
    for pattern in shards:
        path = Path(pattern)
        anchor = Path(path.anchor)
        matches = [path] if path.exists() else sorted(anchor.glob(str(path.relative_to(anchor))))
        for match in matches:
            for folder in (match, *list(match.absolute().parents)[:2]):
                if (folder / MANIFEST_NAME).is_file() and folder.resolve() not in seen:
                    seen.add(folder.resolve())
                    yield folder


def _object_set(datasets: tuple[Path, ...]) -> str | None:
    """Return the digest of the object set that the data were made with, if the data are there and agree on one."""
    digests = set()
    for folder in datasets:
        try:
            digests.add(str(Manifest.load(folder).object_set["sha256"]))
        except (UserError, KeyError):
            continue
    return digests.pop() if len(digests) == 1 else None
