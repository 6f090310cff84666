"""The simulator processes of an evaluation: each owns some environments and obeys the parent over a pipe.

A worker sends one message for each event at once, so that the parent knows what a worker that died was busy with.
Nothing here imports PyTorch, and PyBullet is imported in the worker alone.
"""

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from graspq.common.errors import UserError
from graspq.common.seeding import generator

if TYPE_CHECKING:
    from graspq.objects.object_set import ObjectSet
    from graspq.policies.oracle import Oracle
    from graspq.sim.episode import GraspSimulation, Observation

SCENE_PURPOSE = "evaluate/scene"


@dataclass(frozen=True)
class Stage:
    """All that determines an evaluation's scenes, with the index of the episode; and who acts in the worker.

    Attributes:
        task: the task's settings as JSON.
        objects: folder of the object set.
        split: split that objects are drawn from.
        seed: seed of the scenes.
        oracle: the scripted oracle acts, with the simulation at hand; else the parent sends actions.
    """

    task: dict[str, Any]
    objects: str
    split: str
    seed: int
    oracle: bool


@dataclass(frozen=True)
class Command:
    """Begin `episode` if it is given; else act (with the oracle if `action` is None) and then begin `following`."""

    slot: int
    episode: int | None = None
    action: np.ndarray | None = None
    following: int | None = None


@dataclass(frozen=True)
class Begun:
    """An episode begins with these objects."""

    slot: int
    episode: int
    object_ids: tuple[str, ...]


@dataclass(frozen=True)
class Seen:
    """An episode waits for an action; image uint8 [H, W, 3], pose of the gripper float32 [4]."""

    slot: int
    image: np.ndarray
    step: int
    pose: np.ndarray


@dataclass(frozen=True)
class Ended:
    """An episode has ended; `image` is the frame after the lift, uint8 [H, W, 3]."""

    slot: int
    image: np.ndarray
    steps: int
    reward: float
    info: dict[str, Any]


@dataclass(frozen=True)
class Idle:
    """A slot has nothing to do."""

    slot: int


@dataclass(frozen=True)
class Refused:
    """A mistake of the user that came to light in the worker."""

    message: str


def begin_episode(
    simulation: "GraspSimulation", objects: "ObjectSet", split: str, seed: int, episode: int
) -> "Observation":
    """Build the scene of an episode, a function of (seed, episode) and the object set alone.

    Objects are drawn anew in each episode, loaded into an emptied world and dropped.

    Raises:
        UserError: the object set lacks the split.
    """
    rng = generator(SCENE_PURPOSE, seed, episode)
    simulation.load(simulation.task.draw(objects, split, rng))
    return simulation.reset(rng)


class _Worker:
    """The slots of one process."""

    def __init__(self, connection: Connection, stage: Stage) -> None:
        from graspq.objects.object_set import ObjectSet

        self.connection, self.stage = connection, stage
        self.objects = ObjectSet.load(Path(stage.objects))
        self.simulations: dict[int, GraspSimulation] = {}
        self.oracles: dict[int, Oracle] = {}

    def obey(self, command: Command) -> None:
        """Carry out one command and report."""
        if command.episode is not None:
            self._begin(command.slot, command.episode)
            return
        simulation = self.simulations[command.slot]
        outcome = simulation.step(self._action(simulation, command))
        seen = outcome.observation
        if not outcome.terminated:
            self.connection.send(Seen(command.slot, seen.image, seen.step, seen.gripper_pose))
            return
        self.connection.send(Ended(command.slot, seen.image, simulation.step_count, outcome.reward, outcome.info))
        if command.following is None:
            self.connection.send(Idle(command.slot))
        else:
            self._begin(command.slot, command.following)

    def _begin(self, slot: int, episode: int) -> None:
        from graspq.sim.episode import GraspSimulation
        from graspq.sim.task import task_from_json

        if slot not in self.simulations:
            self.simulations[slot] = GraspSimulation(task_from_json(self.stage.task), self.objects)
        simulation = self.simulations[slot]
        seen = begin_episode(simulation, self.objects, self.stage.split, self.stage.seed, episode)
        if self.stage.oracle:
            self._oracle(slot).begin(simulation)
        self.connection.send(Begun(slot, episode, simulation.object_ids))
        self.connection.send(Seen(slot, seen.image, seen.step, seen.gripper_pose))

    def _action(self, simulation: "GraspSimulation", command: Command) -> np.ndarray:
        if command.action is not None:
            return command.action
        return self._oracle(command.slot).act(simulation.observation, np.random.default_rng(0))

    def _oracle(self, slot: int) -> "Oracle":
        from graspq.policies.oracle import Oracle

        # One for each slot: an oracle follows the plan that it made at the start of an episode.
        return self.oracles.setdefault(slot, Oracle())

    def close(self) -> None:
        """Free the simulations."""
        for simulation in self.simulations.values():
            simulation.close()


@contextlib.contextmanager
def quiet_errors() -> Iterator[None]:
    """Keep standard error quiet: PyBullet greets there on import, once a process, in the midst of a progress bar."""
    kept = os.dup(2)
    try:
        with Path(os.devnull).open("wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def serve(connection: Connection, stage: Stage) -> None:
    """Obey commands until the parent closes the pipe, also by dying."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends us
    try:
        with quiet_errors():
            import graspq.sim.episode  # noqa: F401
        worker = _Worker(connection, stage)
        try:
            while True:
                for command in connection.recv():
                    worker.obey(command)
        finally:
            worker.close()
    except UserError as error:
        connection.send(Refused(error.message))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return


def start(stage: Stage) -> tuple[Any, Connection]:
    """Start a worker process; return it and the parent's end of its pipe."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=serve, args=(theirs, stage), daemon=True)
    process.start()
    theirs.close()
    return process, ours
