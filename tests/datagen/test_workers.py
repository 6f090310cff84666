import pytest

from graspq.common.errors import UserError
from graspq.datagen.settings import CollectionSettings
from graspq.datagen.workers import BlockJob, collect_blocks
from graspq.sim.task import TASKS

SETTINGS = CollectionSettings(block_size=2)


def test_every_block_comes_back_once(regular_objects):
    jobs = [BlockJob(block, 2) for block in range(3)]
    results = list(collect_blocks(jobs, TASKS["regular"], regular_objects.folder, SETTINGS, workers=2))
    assert sorted(job.block for job, _ in results) == [0, 1, 2]
    assert all([episode.block for episode in episodes] == [job.block] * 2 for job, episodes in results)


def test_this_process_gives_the_episodes_of_a_worker(regular_objects):
    jobs = [BlockJob(1, 2, first_episode=5)]
    (_, ours), (_, theirs) = (
        next(iter(collect_blocks(jobs, TASKS["regular"], regular_objects.folder, SETTINGS, workers=workers)))
        for workers in (0, 1)
    )
    assert [episode.episode_id for episode in ours] == [episode.episode_id for episode in theirs] == [5, 6]
    assert all(
        one.images.tobytes() == other.images.tobytes() and one.actions.tobytes() == other.actions.tobytes()
        for one, other in zip(ours, theirs, strict=True)
    )


def test_a_mistake_of_the_user_in_a_worker_arrives_as_one(regular_objects):
    with pytest.raises(UserError, match="no split"):
        list(collect_blocks([BlockJob(0, 1)], TASKS["targeted"], regular_objects.folder, SETTINGS, workers=1))


def test_a_block_that_kills_its_worker_twice_stops_the_run_by_its_name(tmp_path, regular_objects):
    broken = regular_objects.copy_to(tmp_path / "broken")
    for record in broken.objects:
        # A mesh of so many vertices that the simulator dies of it is not at hand; one it cannot load is.
        (broken.folder / record.urdf).write_text("<robot")
    with pytest.raises((UserError, RuntimeError), match=r"block 0"):
        list(collect_blocks([BlockJob(0, 1)], TASKS["regular"], broken.folder, SETTINGS, workers=1))
