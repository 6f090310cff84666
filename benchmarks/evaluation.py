"""Evaluation: episodes a second of `grasp-eval` against one environment at a time in as many processes.

    python benchmarks/evaluation.py runs/mc-regular-10k-seed0

The rivals decide for one state at a time: by the whole network on 64 tiled copies of the picture in every iteration of
CEM, by the trunk anew in every iteration, and by the trunk once, which shows what batches alone are worth. All meet the
same scenes and draw the same noise; `--rival-episodes` lets the slow ones stop after the first of them. Ours starts its
simulators within the clock, as `grasp-eval` does; the rivals' are ready before it.
"""

import contextlib
import statistics
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import click
import torch
from players import Player
from rivals import WAYS, asking
from timing import median_ratio, report, take_turns

from graspq.common.errors import UserError
from graspq.common.machine import available_cores
from graspq.common.options import Command
from graspq.common.seeding import generator
from graspq.evaluate.evaluation import Prepared, play, prepare, stage_of
from graspq.evaluate.jobs import jobs_from_settings
from graspq.evaluate.q_policy import QPolicy
from graspq.evaluate.rollout import POLICY_PURPOSE
from graspq.evaluate.settings import EvalSettings
from graspq.evaluate.workers import Stage, begin_episode

OURS = "graspq"
Successes = dict[int, bool]


def one_at_a_time(
    settings: EvalSettings, stage: Stage, episodes: range, threads: int
) -> Generator[Successes | None, str, None]:
    """A player's part: one environment, one state a decision, asked for in the way that the message names."""
    from graspq.objects.object_set import ObjectSet
    from graspq.sim.episode import GraspSimulation
    from graspq.sim.task import task_from_json

    torch.set_num_threads(threads)
    policy = searching(prepare(jobs_from_settings(settings)[0], settings))
    objects = ObjectSet.load(Path(stage.objects))
    with GraspSimulation(task_from_json(stage.task), objects) as simulation:
        way = yield None
        while True:
            acting = asking(policy, way)
            way = yield {episode: _succeeds(simulation, stage, acting, episode) for episode in episodes}


def _succeeds(simulation: Any, stage: Stage, policy: QPolicy, episode: int) -> bool:
    seen = begin_episode(simulation, simulation.objects, stage.split, stage.seed, episode)
    draws, terminated, info = generator(POLICY_PURPOSE, stage.seed, episode), False, {}
    while not terminated:
        outcome = simulation.step(policy.act_batch(seen.image[None], [seen.step], [draws], seen.gripper_pose[None])[0])
        seen, terminated, info = outcome.observation, outcome.terminated, outcome.info
    return bool(info["success"])


def searching(prepared: Prepared) -> QPolicy:
    """Return the policy of a run.

    Raises:
        UserError: its estimator acts by an actor network: there is no search to compare.
    """
    if not isinstance(prepared.policy, QPolicy):
        raise UserError(f"{prepared.job.run}: acts by an actor network; name a run that searches, such as one of mc")
    return prepared.policy


def ours(prepared: Prepared, settings: EvalSettings, into: list[Successes]) -> Callable[[], None]:
    """Return what runs all episodes as `grasp-eval` does and keeps their successes."""

    def run() -> None:
        rows, _ = play(prepared, settings)
        into.append({row.episode: row.success for row in rows})

    return run


def crew(players: list[Player], way: str, into: list[Successes]) -> Callable[[], None]:
    """Return what lets the players share all episodes and keeps their successes."""

    def run() -> None:
        for player in players:
            player.ask(way)
        into.append({episode: success for player in players for episode, success in player.answer().items()})

    return run


def measure(prepared: Prepared, settings: EvalSettings, turns: int, rival_episodes: int) -> list[dict[str, Any]]:
    """Return a row for us and one for each rival."""
    workers, stage = settings.workers or available_cores(), stage_of(prepared)
    found: dict[str, list[Successes]] = {OURS: [], **{f"one at a time, {way}": [] for way in WAYS}}
    threads = max(1, available_cores() // workers)
    with contextlib.ExitStack() as stack:
        waiting = [
            Player(one_at_a_time, settings, stage, range(number, rival_episodes, workers), threads)
            for number in range(workers)
        ]
        players = [stack.enter_context(player) for player in waiting]
        runs = {OURS: ours(prepared, settings, found[OURS])}
        for way in WAYS:
            name = f"one at a time, {way}"
            runs[name] = crew(players, way, found[name])
        seconds = take_turns(runs, turns)
    pace = {name: [value / len(found[name][0]) for value in values] for name, values in seconds.items()}
    expected = found[OURS][0]
    return [
        {
            "evaluation": name,
            "episodes a second": 1 / statistics.median(values),
            "graspq is faster, times": median_ratio(values, pace[OURS]),
            "episodes": len(found[name][0]),
            "successes": sum(found[name][0].values()),
            "end as ours": sum(expected[episode] == success for episode, success in found[name][0].items()),
        }
        for name, values in pace.items()
    ]


@click.command(cls=Command)
@click.argument("run", type=click.Path(path_type=Path))
@click.option("--episodes", type=click.IntRange(1), default=128, show_default=True, help="Episodes in a turn.")
@click.option(
    "--rival-episodes", type=click.IntRange(1), default=None, help="The rivals', the first of ours; all if not given."
)
@click.option("--turns", type=click.IntRange(1), default=3, show_default=True, help="Turns that are measured.")
@click.option("--workers", type=click.IntRange(1), default=None, help="Processes; the number of cores if not given.")
@click.option("--environments", type=click.IntRange(1), default=32, show_default=True, help="Ours.")
@click.option("--split", default="test", show_default=True, help="Split of the object set.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of the scenes.")
@click.option("--objects", type=click.Path(path_type=Path), default=None, help="Object set; the run's if not given.")
@click.option("--out", type=click.Path(path_type=Path), default=None, help="JSON file for the figures.")
def main(
    run: Path,
    episodes: int,
    rival_episodes: int | None,
    turns: int,
    workers: int | None,
    environments: int,
    split: str,
    seed: int,
    objects: Path | None,
    out: Path | None,
) -> None:
    """Measure the evaluation of RUN, a folder of grasp-train whose policy searches (on the CPU)."""
    settings = EvalSettings(
        runs=(str(run),),
        split=split,
        episodes=episodes,
        seed=seed,
        objects=objects,
        workers=workers or available_cores(),
        environments=environments,
        device="cpu",
    )
    prepared = prepare(jobs_from_settings(settings)[0], settings)
    searching(prepared)
    rows = measure(prepared, settings, turns, min(episodes if rival_episodes is None else rival_episodes, episodes))
    facts = {
        "run": run.as_posix(),
        "workers of each": settings.workers,
        "our environments": environments,
        "threads of our decisions": 1,
        "threads of each rival's process": max(1, available_cores() // (settings.workers or 1)),
        "turns": turns,
    }
    report("Evaluation (CEM: 3 iterations of 64 samples)", rows, facts, out)


if __name__ == "__main__":
    main()
