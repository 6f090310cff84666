"""Rollouts on the real simulator: the same rows whatever the workers, whatever dies, whatever else runs."""

import os
import signal
from pathlib import Path

import numpy as np
import pytest

from graspq.common.errors import UserError
from graspq.evaluate.policies import Policy, RandomObservationPolicy
from graspq.evaluate.records import EpisodeRow
from graspq.evaluate.rollout import Rollout, RolloutError
from graspq.evaluate.workers import Stage, begin_episode, quiet_errors
from graspq.objects.object_set import ObjectSet
from graspq.sim.task import TASKS

EPISODES, ENVIRONMENTS = 5, 3


def stage(objects_folder: Path, *, oracle: bool = False, split: str = "test", seed: int = 0) -> Stage:
    return Stage(TASKS["regular"].settings.to_json(), str(objects_folder), split, seed, oracle)


@pytest.fixture(scope="module")
def random_rollout(objects_folder: Path) -> Rollout:
    rollout = Rollout(
        stage(objects_folder),
        RandomObservationPolicy(),
        episodes=EPISODES,
        environments=ENVIRONMENTS,
        workers=1,
        films=EPISODES,
    )
    rollout.run()
    return rollout


def test_rows_and_frames_do_not_depend_on_the_number_of_workers(objects_folder: Path, random_rollout: Rollout) -> None:
    other = Rollout(
        stage(objects_folder),
        RandomObservationPolicy(),
        episodes=EPISODES,
        environments=ENVIRONMENTS,
        workers=2,
        films=EPISODES,
    )
    assert other.run() == [random_rollout.rows[episode] for episode in range(EPISODES)]
    for ours, theirs in zip(random_rollout.films.chosen(), other.films.chosen(), strict=True):
        assert np.array_equal(ours.frames, theirs.frames)


def test_rows_say_what_happened(random_rollout: Rollout) -> None:
    films = {film.row.episode: film for film in random_rollout.films.chosen()}
    for episode, row in random_rollout.rows.items():
        assert (row.episode, row.seed, row.q) == (episode, 0, None)
        assert len(set(row.object_ids)) == 5 and all(name.startswith("test_") for name in row.object_ids)
        assert row.success == (row.lifted_object is not None) == (row.episode_return == 1.0)
        assert row.end in ("height", "T") and 1 <= row.steps <= 15
        assert films[episode].frames.shape == (row.steps + 1, 64, 64, 3)
        assert films[episode].frames.std() > 10


def test_other_seeds_and_other_episodes_meet_other_scenes(objects_folder: Path, random_rollout: Rollout) -> None:
    first, second = (film.frames[0] for film in random_rollout.films.chosen()[:2])
    assert not np.array_equal(first, second)
    with quiet_errors():
        from graspq.sim.episode import GraspSimulation
    objects = ObjectSet.load(objects_folder)
    with GraspSimulation(TASKS["regular"], objects) as simulation:
        assert not np.array_equal(first, begin_episode(simulation, objects, "test", 1, 0).image)
        assert np.array_equal(second, begin_episode(simulation, objects, "test", 0, 1).image)


def test_the_oracle_meets_the_same_scenes_and_grasps_most_of_them(
    objects_folder: Path, random_rollout: Rollout
) -> None:
    rollout = Rollout(
        stage(objects_folder, oracle=True),
        None,
        episodes=EPISODES,
        environments=ENVIRONMENTS,
        workers=2,
        films=EPISODES,
    )
    rows = rollout.run()
    assert [row.object_ids for row in rows] == [random_rollout.rows[episode].object_ids for episode in range(EPISODES)]
    for ours, theirs in zip(rollout.films.chosen(), random_rollout.films.chosen(), strict=True):
        assert np.array_equal(ours.frames[0], theirs.frames[0])
    assert sum(row.success for row in rows) >= EPISODES - 2


class KillsOnce(RandomObservationPolicy):
    """The random policy, whose first decisions end some simulator processes as a segmentation fault would."""

    def __init__(self, times: int) -> None:
        super().__init__()
        self.times = times
        self.rollout: Rollout | None = None

    def decide(self, images, steps, generators, poses=None):  # type: ignore[no-untyped-def]
        assert self.rollout is not None
        if self.times > 0:
            self.times -= 1
            os.kill(self.rollout._crews[0].process.pid, signal.SIGKILL)
        return super().decide(images, steps, generators, poses)


def test_episodes_of_a_worker_that_died_are_run_again_with_the_same_result(
    objects_folder: Path, random_rollout: Rollout
) -> None:
    policy = KillsOnce(times=1)
    seen: list[EpisodeRow] = []
    policy.rollout = Rollout(stage(objects_folder), policy, episodes=3, environments=2, workers=1, on_row=seen.append)
    assert policy.rollout.run() == [random_rollout.rows[episode] for episode in range(3)]
    assert sorted(row.episode for row in seen) == [0, 1, 2]


def test_an_episode_that_kills_its_worker_twice_is_named(objects_folder: Path) -> None:
    policy = KillsOnce(times=100)
    policy.rollout = Rollout(stage(objects_folder), policy, episodes=2, environments=1, workers=1)
    with pytest.raises(RolloutError, match=r"episode 0 of seed 0 ended its simulator process 2 times \(exit code -9\)"):
        policy.rollout.run()
    assert all(crew.process.exitcode is not None for crew in policy.rollout._crews)


def test_a_missing_split_is_the_users_mistake_also_when_a_worker_finds_it(objects_folder: Path) -> None:
    with pytest.raises(UserError, match="split 'validation'"):
        Rollout(
            stage(objects_folder, split="validation"), RandomObservationPolicy(), episodes=1, environments=1, workers=1
        ).run()


def test_no_worker_outlives_a_rollout(random_rollout: Rollout) -> None:
    assert all(crew.process.exitcode is not None for crew in random_rollout._crews)


def test_a_trained_policy_gives_the_same_rows_with_one_worker_and_two(objects_folder: Path, run_folder: Path) -> None:
    policy = Policy.from_run(run_folder)
    one, two = (
        Rollout(stage(objects_folder), policy, episodes=4, environments=3, workers=workers).run() for workers in (1, 2)
    )
    assert one == two
    assert all(row.q is not None and np.isfinite(row.q) for row in one)
