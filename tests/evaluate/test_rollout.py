"""Rollouts on the real simulator: the same rows whatever the workers, whatever dies, whatever else runs."""

from pathlib import Path

import numpy as np
import pytest

from graspq.common.errors import UserError
from graspq.engine import EngineSettings
from graspq.evaluate.films import Film
from graspq.evaluate.records import EpisodeRow
from graspq.evaluate.rollout import Rollouts, run_rollouts
from graspq.evaluate.scenes import Scenes
from graspq.objects.object_set import ObjectSet
from graspq.policies.named import policy_named
from graspq.policies.of_run import load
from graspq.policies.random import RandomPolicy
from graspq.sim.episode import GraspSimulation
from graspq.sim.task import TASKS

EPISODES = 5
Result = tuple[list[EpisodeRow], list[Film]]


def scenes(objects_folder: Path, *, split: str = "test", seed: int = 0) -> Scenes:
    return Scenes(TASKS["regular"], objects_folder, split, seed)


def rolled(work: Rollouts, workers: int, episodes: int = EPISODES) -> Result:
    return run_rollouts(work, episodes, EngineSettings(workers=workers), films=episodes)


@pytest.fixture(scope="module")
def at_random(objects_folder: Path) -> Result:
    return rolled(Rollouts(scenes(objects_folder), RandomPolicy()), 0)


def test_rows_and_frames_do_not_depend_on_the_number_of_workers(objects_folder: Path, at_random: Result) -> None:
    rows, films = rolled(Rollouts(scenes(objects_folder), RandomPolicy()), 2)
    assert rows == at_random[0]
    for ours, theirs in zip(films, at_random[1], strict=True):
        assert np.array_equal(ours.frames, theirs.frames)


def test_rows_say_what_happened(at_random: Result) -> None:
    films = {film.row.episode: film for film in at_random[1]}
    for episode, row in enumerate(at_random[0]):
        assert (row.episode, row.seed, row.q) == (episode, 0, None)
        assert len(set(row.object_ids)) == 5 and all(name.startswith("test_") for name in row.object_ids)
        assert row.success == (row.lifted_object is not None) == (row.episode_return == 1.0)
        assert row.ended_by in ("height", "T") and 1 <= row.steps <= 15
        assert films[episode].frames.shape == (row.steps + 1, 64, 64, 3)
        assert films[episode].frames.std() > 10


def test_other_seeds_and_other_episodes_meet_other_scenes(objects_folder: Path, at_random: Result) -> None:
    first, second = (film.frames[0] for film in at_random[1][:2])
    assert not np.array_equal(first, second)
    with GraspSimulation(TASKS["regular"], ObjectSet.load(objects_folder)) as simulation:
        scenes(objects_folder, seed=1).begin(simulation, 0)
        assert not np.array_equal(first, simulation.observation.image)
        scenes(objects_folder).begin(simulation, 1)
        assert np.array_equal(second, simulation.observation.image)


def test_the_oracle_meets_the_same_scenes_and_grasps_most_of_them(objects_folder: Path, at_random: Result) -> None:
    rows, films = rolled(Rollouts(scenes(objects_folder), policy_named("oracle")), 0)
    assert [row.object_ids for row in rows] == [row.object_ids for row in at_random[0]]
    for ours, theirs in zip(films, at_random[1], strict=True):
        assert np.array_equal(ours.frames[0], theirs.frames[0])
    assert sum(row.success for row in rows) >= EPISODES - 2


def test_episodes_of_a_worker_that_died_are_played_again_with_the_same_result(
    objects_folder: Path, at_random: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A policy of a user's own: it is made anew in every worker.
    (tmp_path / "kills_once.py").write_text(
        "import os, pathlib, signal\n"
        "from graspq.policies.random import RandomPolicy\n"
        "class Kills(RandomPolicy):\n"
        "    def act(self, observation, rng):\n"
        "        if pathlib.Path('mark').exists():\n"
        "            pathlib.Path('mark').unlink()\n"
        "            os.kill(os.getpid(), signal.SIGKILL)\n"
        "        return super().act(observation, rng)\n"
    )
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mark").touch()
    rows, _ = rolled(Rollouts(scenes(objects_folder), policy_named("kills_once:Kills")), 1)
    assert rows == at_random[0] and not (tmp_path / "mark").exists()


def test_a_missing_split_is_the_users_mistake_also_when_a_worker_finds_it(objects_folder: Path) -> None:
    with pytest.raises(UserError, match="split 'nowhere'"):
        rolled(Rollouts(scenes(objects_folder, split="nowhere"), RandomPolicy()), 1)


def test_a_trained_policy_gives_the_same_rows_with_one_worker_and_two(objects_folder: Path, run_folder: Path) -> None:
    work = Rollouts(scenes(objects_folder), load(run_folder))
    (one, _), (two, _) = (rolled(work, workers, 4) for workers in (0, 2))
    assert one == two
    assert all(row.q is not None and np.isfinite(row.q) for row in one)
