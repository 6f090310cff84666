"""Rollouts: a few episodes at a time, each a function of (policy, scenes, index), wherever the engine has workers.

A worker holds one simulation and the policy, and decides for one state at a time in one thread: no result depends on
the number of workers or on what else they play.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graspq.common.machine import one_thread
from graspq.common.seeding import generator
from graspq.engine import EngineSettings, Place, run
from graspq.evaluate.films import Film, FilmKeeper
from graspq.evaluate.records import EpisodeRow
from graspq.evaluate.scenes import Scenes
from graspq.objects.object_set import ObjectSet
from graspq.sim.play import Played, Policy, play

EPISODES_PER_UNIT = 2
UNITS_PER_WORKER = 1000  # the simulator leaks shapes: workers are renewed
_PURPOSE = "evaluate/policy"


@dataclass(frozen=True)
class Rollouts:
    """What the workers of an evaluation do: a unit is a range of episodes.

    Attributes:
        scenes: of the evaluation.
        policy: who acts.
    """

    scenes: Scenes
    policy: Policy

    @property
    def modules(self) -> list[str]:
        """Names of the modules that a worker needs."""
        acting = getattr(self.policy, "acting", None)
        networks = acting.networks.values() if acting is not None else ()
        own = [type(part).__module__ for part in (self.policy, *networks)]
        return [__name__, "graspq.sim.episode", *own]

    def folders(self) -> Sequence[Path]:
        """Return the object set's folder."""
        return [self.scenes.objects]

    @contextlib.contextmanager
    def open(self, place: Place) -> Iterator[Callable[[range], list[Film]]]:
        """Yield what plays the episodes of a unit."""
        # Imported here: the parent needs no simulator.
        from graspq.sim.episode import GraspSimulation

        objects = ObjectSet.load(place(self.scenes.objects))
        with one_thread(), GraspSimulation(self.scenes.task, objects) as simulation:
            yield lambda episodes: [self._filmed(simulation, episode) for episode in episodes]

    def _filmed(self, simulation: Any, episode: int) -> Film:
        self.scenes.begin(simulation, episode)
        played = self.play(simulation, episode)
        row = EpisodeRow(
            episode=episode,
            seed=self.scenes.seed,
            object_ids=simulation.object_ids,
            success=played.success,
            lifted_object=played.lifted_object,
            steps=len(played.actions),
            ended_by=played.ended_by,
            episode_return=float(played.rewards.sum()),
            q=played.q,
        )
        return Film(row, played.frames)

    def play(self, simulation: Any, episode: int) -> Played:
        """Play an episode that `scenes.begin` has started."""
        return play(simulation, self.policy, generator(_PURPOSE, self.scenes.seed, episode))


def run_rollouts(
    work: Rollouts,
    episodes: int,
    settings: EngineSettings,
    *,
    films: int = 0,
    on_row: Callable[[EpisodeRow], None] | None = None,
) -> tuple[list[EpisodeRow], list[Film]]:
    """Play the episodes 0 .. `episodes` - 1; return their rows in order, and the films that are kept.

    Args:
        work: scenes and policy.
        episodes: how many, at least 1; episode i is the same in a longer evaluation.
        settings: which engine, how many workers.
        films: number of episodes whose frames are kept.
        on_row: called for each finished episode, in no fixed order.

    Raises:
        UserError: the object set or a user's policy is at fault, or some episodes ended two workers each.
    """
    rows: dict[int, EpisodeRow] = {}
    keeper = FilmKeeper(films)
    units = (range(first, min(first + EPISODES_PER_UNIT, episodes)) for first in range(0, episodes, EPISODES_PER_UNIT))
    for _, played in run(work, units, settings, name=_name, units_per_worker=UNITS_PER_WORKER, modules=work.modules):
        for film in played:
            rows[film.row.episode] = film.row
            keeper.offer(film)
            if on_row is not None:
                on_row(film.row)
    return [rows[episode] for episode in range(episodes)], keeper.chosen()


def _name(episodes: range) -> str:
    return f"episodes {episodes[0]} to {episodes[-1]}"
