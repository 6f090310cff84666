"""Evaluation: episodes a second of `grasp-eval` against other ways to ask the network, one environment at a time.

python benchmarks/evaluation_speed.py runs/mc-regular-10k-seed0
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from graspq.benchmarks.harness import (
    Ratio,
    Result,
    TurnsSettings,
    apart,
    check_equal,
    command,
    compared,
    median_ratio,
    take_turns,
)
from graspq.benchmarks.rivals import ANEW, ONCE, TILED, WAYS, asking
from graspq.common.errors import UserError
from graspq.common.machine import available_cores
from graspq.common.options import setting
from graspq.engine import EngineSettings
from graspq.evaluate.evaluation import prepare
from graspq.evaluate.jobs import jobs_from_settings
from graspq.evaluate.rollout import Rollouts, run_rollouts
from graspq.evaluate.settings import EvalSettings
from graspq.policies.of_run import RunPolicy
from graspq.sim.observation import Observation

OURS = "graspq, start-up included"
Played = tuple[float, dict[int, bool]]  # seconds, and which episodes succeeded


@dataclass(frozen=True, kw_only=True)
class EvaluationSettings(TurnsSettings):
    """Settings of this benchmark."""

    run: Path = setting(help="Run folder whose policy searches.", positional=True, metavar="RUN")
    turns: int = setting(3, help="Turns that are measured.", minimum=1)
    episodes: int = setting(128, help="Episodes in a turn.", minimum=1)
    rival_episodes: int = setting(128, help="The rivals', the first of ours.", minimum=1)


@torch.inference_mode()
def check_rivals(policy: RunPolicy) -> None:
    """Refuse rivals that find other actions or Q than ours, and a policy without a search (`UserError`)."""
    if not policy.searches:
        raise UserError(f"{policy.name}: acts by an actor network; name a run that searches, such as one of mc")
    shape = policy.origin.specification.image_shape
    image = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    seen = Observation(image, 3, np.zeros(policy.acting.action.size, np.float32))

    def found(acting: RunPolicy) -> torch.Tensor:
        action = acting.act(seen, np.random.default_rng(1))
        return torch.from_numpy(np.append(action, acting.q if acting.q is not None else np.nan))

    check_equal(found(policy), {way: found(asking(policy, way)) for way in WAYS})


def at_once(rollouts: Rollouts, episodes: int) -> Played:
    """Evaluate some episodes as `grasp-eval` does."""
    start = time.perf_counter()
    rows, _ = run_rollouts(rollouts, episodes, EngineSettings())
    return time.perf_counter() - start, {row.episode: row.success for row in rows}


def one_at_a_time(rollouts: Rollouts, episodes: range) -> Played:
    """Play some episodes in this process; the first is played once before."""
    with rollouts.open(lambda folder: folder) as play:
        play(episodes[:1])
        start = time.perf_counter()
        films = play(episodes)
        return time.perf_counter() - start, {film.row.episode: film.row.success for film in films}


def together(rollouts: Rollouts, episodes: int) -> Played:
    """Let as many processes as there are cores share some episodes; the seconds are those of the slowest."""
    workers = min(available_cores(), episodes)
    parts = [partial(one_at_a_time, rollouts, range(number, episodes, workers)) for number in range(workers)]
    seconds, successes = zip(*apart(*parts), strict=True)
    return max(seconds), {episode: success for part in successes for episode, success in part.items()}


def measure(settings: EvaluationSettings) -> Result:
    """Return episodes a second of the evaluation of RUN and of the rivals, on the CPU."""
    given = EvalSettings(runs=(str(settings.run),), device="cpu")
    prepared = prepare(jobs_from_settings(given)[0], given)
    assert prepared.run is not None
    check_rivals(prepared.run)
    theirs = min(settings.rival_episodes, settings.episodes)
    arms: dict[str, Callable[[int], Played]] = {OURS: lambda turn: at_once(prepared.rollouts, settings.episodes)}
    for way in WAYS:
        rollouts = Rollouts(prepared.scenes, asking(prepared.run, way))
        arms[way] = lambda turn, rollouts=rollouts: together(rollouts, theirs)  # type: ignore[misc]
    played = take_turns(arms, settings.turns, warm_up=False)
    seconds = {name: [spent / len(successes) for spent, successes in turns] for name, turns in played.items()}
    ours = played[OURS][0][1]
    same = {way: sum(ours[episode] == one for episode, one in played[way][0][1].items()) for way in WAYS}
    says = "episodes a second, against one at a time with tiled copies"
    once = "… one at a time, trunk once (our network), its start not counted"
    return Result(
        [
            Ratio(says, median_ratio(seconds[TILED], seconds[OURS]), bar=4, aim=8),
            Ratio("… one at a time, trunk each iteration", median_ratio(seconds[ANEW], seconds[OURS])),
            Ratio(once, median_ratio(seconds[ONCE], seconds[OURS]), aim=0.95),
        ],
        {"Evaluation (CEM: 3 iterations of 64 samples)": compared("evaluation", "episode", seconds, TILED)},
        {"workers of each": available_cores(), "successes of ours": sum(ours.values()), "end as ours": same},
    )


main = command(EvaluationSettings, measure)

if __name__ == "__main__":
    main()
