"""The policy of a training run: the search over its Q-function, or its actor network.

`load("runs/mc").act(observation, rng)` is all that a robot's control loop needs. Dimension key: H W C image, A action.
"""

import copy
import dataclasses
import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import torch

from graspq.common.errors import UserError
from graspq.sim.observation import Observation
from graspq.sim.task import task_from_json
from graspq.train.acting import Acting, ActionSelection, ObservedState, StochasticSearch
from graspq.train.device import Device, chosen_device
from graspq.train.networks.network import NetworkSpecification
from graspq.train.search_settings import CemSettings


@dataclasses.dataclass(frozen=True)
class Origin:
    """Where a run's policy comes from.

    Attributes:
        algo: the estimator.
        step: training step of the checkpoint.
        sha256: of the weights that act and whatever the estimator keeps beside them.
        task: settings of the task that the data were collected on, as JSON.
        config: the run's `config.json`.
        specification: of the networks.
    """

    algo: str
    step: int
    sha256: str
    task: dict[str, Any]
    config: dict[str, Any]
    specification: NetworkSpecification


class RunPolicy:
    """Acts as a run's estimator says; decides for one state at a time, its trunk computed once.

    It may be pickled: the weights travel as bytes. The networks are put on the device with the first decision.

    Attributes:
        exploration: 0.
        q: what the action just given is worth, a probability of success; None before, and where the run cannot say.
        origin: the run.
        acting: its networks and what else decides, on the CPU.
        selection: how it finds its action.
        cem: settings of a search.
    """

    exploration = 0.0

    def __init__(
        self, origin: Origin, acting: Acting, selection: ActionSelection, cem: CemSettings, device: Device = "auto"
    ) -> None:
        """Prepare; `load` reads a run.

        Raises:
            UserError: a GPU was asked for and there is none.
        """
        self.origin, self.acting, self.selection, self.cem, self.device = origin, acting, selection, cem, device
        self.q: float | None = None
        self._device = chosen_device(device)
        self._placed: Acting | None = None

    @property
    def name(self) -> str:
        """What the episodes table calls it, `ALGO@STEP`."""
        return f"{self.origin.algo}@{self.origin.step}"

    @property
    def searches(self) -> bool:
        """Whether it searches, by `cem`."""
        return isinstance(self.selection, StochasticSearch)

    def act(self, observation: Observation, rng: np.random.Generator) -> np.ndarray:
        """Return an action, float32 [A] in [-1, 1].

        Args:
            observation: its image uint8 [H, W, C]. No network sees the gripper's pose; a search for motions to a last
                pose keeps that inside the workspace by it.
            rng: noise of the search; an actor has none.
        """
        if self._placed is None:
            self._placed = _on(self._device, self.acting)
        with torch.inference_mode():
            image = torch.from_numpy(np.ascontiguousarray(observation.image)).to(self._device).unsqueeze(0)
            step = torch.tensor([observation.step], device=self._device)
            pose = torch.from_numpy(np.asarray(observation.gripper_pose)).to(self._device).unsqueeze(0)
            action, q = self.selection.act(self._placed, ObservedState(image, step, pose), rng, self.cem)
            self.q = None if q is None else float(q[0])
            answer: np.ndarray = action[0].float().cpu().numpy()
        return answer

    def identity(self) -> dict[str, Any]:
        """Return what tells this policy from others: its weights and, where it searches, how."""
        return {"network": self.origin.sha256, **({"cem": self.cem.to_json()} if self.searches else {})}

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel as bytes: torch would pass tensors to other processes through shared memory.

        Raises:
            UserError: a class of the networks stands inside a function.
        """
        content = io.BytesIO()
        try:
            torch.save(self.acting, content)
        except (AttributeError, pickle.PicklingError) as error:
            raise UserError(
                f"--network {self.origin.specification.name}: cannot be sent to workers ({error}); "
                "define its classes at the top of a module, or use --workers 0"
            ) from None
        return _rebuilt, (self.origin, content.getvalue(), self.selection, self.cem, self.device)


def _rebuilt(origin: Origin, content: bytes, selection: ActionSelection, cem: CemSettings, device: Device) -> RunPolicy:
    acting: Acting = torch.load(io.BytesIO(content), weights_only=False)
    return RunPolicy(origin, acting, selection, cem, device)


def load(
    path: Path | str, checkpoint: int | None = None, *, cem: CemSettings | None = None, device: Device = "auto"
) -> RunPolicy:
    """Return the policy of a training run.

    Args:
        path: the run's folder.
        checkpoint: training step of the checkpoint; the last where not given.
        cem: settings of the search; the usual ones where not given.
        device: where the networks run; `auto` takes a GPU if there is one.

    Raises:
        UserError: there is no run, no such checkpoint, or it is damaged.
    """
    # Imported late: a worker that is handed a policy needs no estimators, and their imports take seconds.
    from graspq.train.checkpoint import STATE_FILE, load_acting
    from graspq.train.estimators import estimator_named

    if (Path(path) / STATE_FILE).is_file():
        run = Path(path).parent.parent
        raise UserError(f"{path}: a checkpoint, expected its run; name {run} with --checkpoint STEP")
    loaded = load_acting(path, checkpoint)
    try:
        algo, task = str(loaded.config["settings"]["algo"]), dict(loaded.config["dataset"]["task"])
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{Path(path) / 'config.json'}: not the configuration of a training run ({error!r})") from None
    acting = Acting(loaded.networks, loaded.kept, loaded.specification.action, _pose_bounds(task))
    origin = Origin(algo, loaded.step, loaded.sha256, task, loaded.config, loaded.specification)
    selection = estimator_named(algo).action_selection
    return RunPolicy(origin, acting, selection, cem if cem is not None else CemSettings(), device)


def _on(device: torch.device, acting: Acting) -> Acting:
    """Return a copy on a device."""
    bounds = acting.pose_bounds
    return dataclasses.replace(
        acting,
        networks={name: copy.deepcopy(network).to(device) for name, network in acting.networks.items()},
        kept={name: tensor.to(device) for name, tensor in acting.kept.items()},
        pose_bounds=None if bounds is None else (bounds[0].to(device), bounds[1].to(device)),
    )


def _pose_bounds(task: dict[str, Any]) -> tuple[torch.Tensor, torch.Tensor] | None:
    """Return the workspace of the run's task; None where the task is not at hand, as on a robot it need not be."""
    try:
        low, high = task_from_json(task).settings.workspace_bounds
    except UserError:
        return None
    return torch.tensor(low), torch.tensor(high)
