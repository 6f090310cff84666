"""Evaluation: episodes a second of `grasp-eval` against other ways to ask the network, one environment at a time.

python benchmarks/evaluation_speed.py runs/mc-regular-10k-seed0
"""

import statistics
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from graspq.benchmarks.measuring import (
    Call,
    Ratio,
    Result,
    TurnsSettings,
    apart,
    command,
    greatest_difference,
    median_ratio,
)
from graspq.benchmarks.rivals import ANEW, ONCE, TILED, WAYS, asking
from graspq.common.errors import UserError
from graspq.common.machine import available_cores
from graspq.common.options import setting
from graspq.evaluate.evaluation import prepare
from graspq.evaluate.jobs import jobs_from_settings
from graspq.evaluate.rollout import Rollouts, run_rollouts
from graspq.evaluate.settings import EvalSettings
from graspq.policies.of_run import RunPolicy
from graspq.sim.observation import Observation

OURS = "graspq, start-up included"
Successes = dict[int, bool]


@dataclass(frozen=True, kw_only=True)
class EvaluationSettings(TurnsSettings):
    """Settings of this benchmark."""

    run: Path = setting(help="Run folder whose policy searches.", positional=True, metavar="RUN")
    turns: int = setting(3, help="Turns that are measured.", minimum=1)
    episodes: int = setting(128, help="Episodes in a turn.", minimum=1)
    rival_episodes: int | None = setting(None, help="The rivals', the first of ours; all if not given.", minimum=1)
    workers: int | None = setting(None, help="Processes; the number of cores if not given.", minimum=1)
    split: str = setting("test", help="Split of the object set.")
    seed: int = setting(0, help="Seed of the scenes.", minimum=0)
    objects: Path | None = setting(None, help="Object set; the run's if not given.")


@torch.inference_mode()
def check_rivals(policy: RunPolicy) -> None:
    """Refuse rivals that find other actions or Q than ours, on pictures of noise.

    Raises:
        UserError: they do, or the policy has no search that could be compared.
    """
    if not policy.searches:
        raise UserError(f"{policy.name}: acts by an actor network; name a run that searches, such as one of mc")
    shape = policy.origin.specification.image_shape
    image = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    seen = Observation(image, 3, np.zeros(policy.acting.action.size, np.float32))

    def found(acting: RunPolicy) -> torch.Tensor:
        action = acting.act(seen, np.random.default_rng(1))
        return torch.from_numpy(np.append(action, acting.q if acting.q is not None else np.nan))

    greatest_difference(found(policy), {way: found(asking(policy, way)) for way in WAYS})


def one_at_a_time(rollouts: Rollouts, episodes: range) -> tuple[float, Successes]:
    """Return the seconds of some episodes in this process, and their successes; the first is played once before."""
    with rollouts.open(lambda folder: folder) as play:
        play(episodes[:1])
        start = time.perf_counter()
        films = play(episodes)
        return time.perf_counter() - start, {film.row.episode: film.row.success for film in films}


def together(rollouts: Rollouts, episodes: int, workers: int) -> tuple[float, Successes]:
    """Return the seconds of the slowest of so many processes that share the episodes, and all successes."""
    calls = [Call(one_at_a_time, (rollouts, range(number, episodes, workers))) for number in range(workers)]
    seconds, successes = zip(*apart(calls, at_once=workers), strict=True)
    return max(seconds), {episode: success for part in successes for episode, success in part.items()}


def measure(settings: EvaluationSettings) -> Result:
    """Return episodes a second of the evaluation of RUN, and of the rivals (on the CPU)."""
    workers = settings.workers if settings.workers is not None else available_cores()
    given = EvalSettings(
        runs=(str(settings.run),),
        split=settings.split,
        episodes=settings.episodes,
        seed=settings.seed,
        objects=settings.objects,
        workers=workers,
        device="cpu",
    )
    prepared = prepare(jobs_from_settings(given)[0], given)
    assert prepared.run is not None
    check_rivals(prepared.run)
    theirs = min(max(settings.rival_episodes or settings.episodes, workers), settings.episodes)
    pace: dict[str, list[float]] = {name: [] for name in (OURS, *WAYS)}
    successes: dict[str, Successes] = {}
    for turn in range(settings.turns):
        start = time.perf_counter()
        played, _ = run_rollouts(prepared.rollouts, settings.episodes, given.where)
        pace[OURS].append((time.perf_counter() - start) / settings.episodes)
        successes[OURS] = {row.episode: row.success for row in played}
        for way in list(WAYS)[:: 1 if turn % 2 else -1]:
            rollouts = Rollouts(prepared.scenes, asking(prepared.run, way))
            seconds, successes[way] = together(rollouts, theirs, workers)
            pace[way].append(seconds / theirs)
    times = {name: median_ratio(values, pace[OURS]) for name, values in pace.items()}
    rows = [
        {
            "evaluation": name,
            "episodes a second": 1 / statistics.median(values),
            "graspq is faster, times": times[name],
            "episodes": len(successes[name]),
            "successes": sum(successes[name].values()),
            "end as ours": sum(successes[OURS][episode] == one for episode, one in successes[name].items()),
        }
        for name, values in pace.items()
    ]
    return Result(
        [
            Ratio("episodes a second, against one at a time with tiled copies", times[TILED], bar=4, aim=8),
            Ratio("… one at a time, trunk each iteration", times[ANEW]),
            Ratio("… one at a time, trunk once (our network), its start not counted", times[ONCE], aim=0.95),
        ],
        {"Evaluation (CEM: 3 iterations of 64 samples)": rows},
        {"workers of each": workers},
    )


main = command(EvaluationSettings, measure)

if __name__ == "__main__":
    main()
