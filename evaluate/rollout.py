"""Rollouts in groups: environments in worker processes, one batched decision in the parent for each group of them.

The environments of a group act in lockstep; while the parent decides for one group, the workers simulate the others.
Episode i runs in slot i mod `environments`, its scene and its noise are functions of (seed, i), a group is a fixed set
of slots, and every decision is made on a group's whole batch with that slot's row: so no result depends on the number
of workers or on what else runs.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from typing import Any

import click
import numpy as np

from graspq.common.errors import UserError
from graspq.common.machine import available_cores
from graspq.common.seeding import generator
from graspq.evaluate.films import FilmKeeper
from graspq.evaluate.policies import Policy
from graspq.evaluate.records import EpisodeRow
from graspq.evaluate.settings import GROUP
from graspq.evaluate.workers import Begun, Command, Ended, Idle, Refused, Seen, Stage, start

POLICY_PURPOSE = "evaluate/policy"
ATTEMPTS = 2


class RolloutError(click.ClickException):
    """An episode that ends its simulator process each time it runs: a defect, reported in one line."""


@dataclass
class _Slot:
    """An environment: the episodes that remain for it, and the state of the one that runs."""

    episodes: list[int]
    episode: int | None = None
    object_ids: tuple[str, ...] = ()
    rng: np.random.Generator | None = None
    image: np.ndarray | None = None
    step: int = 0
    pose: np.ndarray = field(default_factory=lambda: np.zeros(4, dtype=np.float32))
    q: float | None = None
    frames: list[np.ndarray] = field(default_factory=list)


@dataclass
class _Crew:
    """A worker process, its pipe, the slots it serves, and the commands it has not answered yet, in order."""

    process: Any
    connection: Any
    slots: list[int]
    pending: list[Command] = field(default_factory=list)


class Rollout:
    """Runs the episodes of one evaluation; use `run`."""

    def __init__(
        self,
        stage: Stage,
        policy: Policy | None,
        *,
        episodes: int,
        environments: int,
        workers: int | None = None,
        films: int = 0,
        on_row: Callable[[EpisodeRow], None] | None = None,
    ) -> None:
        """Prepare.

        Args:
            stage: what determines the scenes.
            policy: decides in the parent; None when the oracle acts in the workers (`stage.oracle`).
            episodes: number of episodes, at least 1; episode i is the same in a longer evaluation.
            environments: number of slots; `GROUP` of them are the rows of a batch.
            workers: processes; all cores by default.
            films: number of episodes whose frames are kept.
            on_row: called for each finished episode, in no fixed order.
        """
        self.stage, self.policy, self.episodes = stage, policy, episodes
        self.slots = [_Slot(list(range(slot, episodes, environments))) for slot in range(environments)]
        numbers = range(environments)
        self._groups = [numbers[first : first + GROUP] for first in numbers[::GROUP]]
        busy = min(environments, episodes)
        self.worker_count = max(1, min(workers or available_cores(), busy))
        self.films = FilmKeeper(films)
        self.on_row = on_row
        self.rows: dict[int, EpisodeRow] = {}
        self._crews: list[_Crew] = []
        self._deaths: dict[int, int] = {}

    def run(self) -> list[EpisodeRow]:
        """Run all episodes and return their rows in order.

        Raises:
            UserError: the object set or a user's policy is at fault.
            RolloutError: an episode ended its simulator process twice.
        """
        busy = range(min(len(self.slots), self.episodes))
        try:
            for number in range(self.worker_count):
                process, connection = start(self.stage)
                self._crews.append(_Crew(process, connection, list(busy[number :: self.worker_count])))
            for crew in self._crews:
                self._send(crew, [self._begin(slot) for slot in crew.slots])
            self._loop()
        finally:
            self._stop()
        return [self.rows[episode] for episode in range(self.episodes)]

    def _loop(self) -> None:
        while any(crew.pending for crew in self._crews):
            self._listen()
            unanswered = {command.slot for crew in self._crews for command in crew.pending}
            for group in self._groups:
                waiting = [slot for slot in group if self.slots[slot].image is not None]
                if waiting and unanswered.isdisjoint(group):
                    self._answer(group, waiting)

    def _answer(self, group: range, waiting: list[int]) -> None:
        actions = self._decide(group)
        for crew in self._crews:
            self._send(crew, [self._act(slot, actions.get(slot)) for slot in crew.slots if slot in waiting])

    def _decide(self, group: range) -> dict[int, np.ndarray]:
        """Return the actions of a group's slots; none where the oracle acts."""
        if self.policy is None:
            return {}
        slots = [self.slots[number] for number in group]
        shape = next(slot.image.shape for slot in slots if slot.image is not None)
        images = np.zeros((len(slots), *shape), dtype=np.uint8)
        steps = np.zeros(len(slots), dtype=np.int64)
        for row, slot in enumerate(slots):
            if slot.image is not None:
                images[row], steps[row] = slot.image, slot.step
        poses = np.stack([slot.pose for slot in slots])
        decision = self.policy.decide(images, steps, [slot.rng for slot in slots], poses)
        if decision.q is not None:
            for row, slot in enumerate(slots):
                slot.q = float(decision.q[row])
        return {number: decision.actions[row].copy() for row, number in enumerate(group)}

    def _begin(self, slot: int) -> Command:
        return Command(slot, episode=self.slots[slot].episodes[0])

    def _act(self, slot: int, action: np.ndarray | None) -> Command:
        following = self.slots[slot].episodes[1] if len(self.slots[slot].episodes) > 1 else None
        self.slots[slot].image = None
        return Command(slot, action=action, following=following)

    def _send(self, crew: _Crew, commands: list[Command]) -> None:
        crew.pending += commands
        try:
            if commands:
                crew.connection.send(commands)
        except (BrokenPipeError, ConnectionResetError):
            pass  # the worker is dead: reading from it says so

    def _listen(self) -> None:
        """Hear one message of each worker that has something to say; workers that die are replaced."""
        ready = wait([crew.connection for crew in self._crews if crew.pending])
        for crew in [crew for crew in self._crews if crew.connection in ready]:
            try:
                self._heard(crew, crew.connection.recv())
            except (EOFError, ConnectionResetError):
                self._replace(crew)

    def _heard(self, crew: _Crew, message: Begun | Seen | Ended | Idle | Refused) -> None:
        if isinstance(message, Refused):
            raise UserError(message.message)
        slot = self.slots[message.slot]
        if isinstance(message, Begun):
            slot.episode, slot.object_ids, slot.frames, slot.q = message.episode, message.object_ids, [], None
            slot.rng = generator(POLICY_PURPOSE, self.stage.seed, message.episode)
        elif isinstance(message, Ended):
            self._finish(slot, message)
        else:
            if isinstance(message, Seen):
                slot.image, slot.step, slot.pose = message.image, message.step, message.pose
                slot.frames.append(message.image)
            crew.pending = [command for command in crew.pending if command.slot != message.slot]

    def _finish(self, slot: _Slot, ended: Ended) -> None:
        assert slot.episode is not None
        row = EpisodeRow(
            episode=slot.episode,
            seed=self.stage.seed,
            object_ids=slot.object_ids,
            success=bool(ended.info["success"]),
            lifted_object=ended.info["lifted_object"],
            steps=ended.steps,
            end=ended.info["end"],
            episode_return=ended.reward,
            q=slot.q,
        )
        self.rows[slot.episode] = row
        self.films.offer(row, [*slot.frames, ended.image])
        slot.episodes.pop(0)
        slot.episode, slot.rng = None, None
        if self.on_row is not None:
            self.on_row(row)

    def _replace(self, crew: _Crew) -> None:
        """Start a dead worker anew; its episodes begin again, and the one it was busy with must not kill it twice."""
        crew.process.join()
        guilty = next(iter(self.slots[crew.pending[0].slot].episodes), self.episodes)
        self._deaths[guilty] = self._deaths.get(guilty, 0) + 1
        if self._deaths[guilty] >= ATTEMPTS:
            raise RolloutError(
                f"episode {guilty} of seed {self.stage.seed} ended its simulator process {ATTEMPTS} times "
                f"(exit code {crew.process.exitcode}); nothing was written, please report it with the object set"
            )
        crew.connection.close()
        crew.process, crew.connection = start(self.stage)
        for number in crew.slots:
            slot = self.slots[number]
            slot.episode, slot.rng, slot.image, slot.frames = None, None, None, []
        crew.pending = []
        self._send(crew, [self._begin(slot) for slot in crew.slots if self.slots[slot].episodes])

    def _stop(self) -> None:
        """End the workers, whatever they are doing."""
        for crew in self._crews:
            crew.connection.close()
        for crew in self._crews:
            crew.process.terminate()
            crew.process.join()


def run_episodes(stage: Stage, policy: Policy | None, **settings: Any) -> tuple[Sequence[EpisodeRow], FilmKeeper]:
    """Run an evaluation's episodes; return their rows in order, and the films. See `Rollout` for the settings."""
    rollout = Rollout(stage, policy, **settings)
    return rollout.run(), rollout.films
