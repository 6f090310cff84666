"""Workers on a Ray cluster of two nodes on this machine, and on a Ray of this machine's own."""

import logging
import signal
import time
from pathlib import Path

import pytest
from ending import end_in_the_middle
from units_of_work import ReadsFolder, Squares

from graspq.common.errors import UserError
from graspq.datagen.collect import Block, Collection, collected
from graspq.datagen.settings import CollectionSettings
from graspq.engine import EngineSettings, run
from graspq.evaluate.rollout import Rollouts, run_rollouts
from graspq.evaluate.scenes import Scenes
from graspq.policies.random import RandomPolicy
from graspq.sim.task import TASKS

pytest.importorskip("ray")


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """Two nodes of one core each, the first of which is the caller's."""
    from ray.cluster_utils import Cluster

    monkeypatch = pytest.MonkeyPatch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
    logging.disable(logging.WARNING)
    patient = {"health_check_initial_delay_ms": 0, "health_check_period_ms": 500, "health_check_failure_threshold": 4}
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "_system_config": patient})
    made.add_node(num_cpus=1)
    yield made
    made.shutdown()
    logging.disable(logging.NOTSET)
    monkeypatch.undo()


@pytest.fixture
def on_cluster(cluster):
    return EngineSettings(engine="ray", ray_address=cluster.address)


def test_units_come_back_with_the_results_of_the_local_engine_and_deaths_are_dealt_with(on_cluster, tmp_path):
    results = []
    with pytest.raises(UserError, match=r"^unit 'die' \(its process ended\) ended its worker twice; all else is done"):
        for unit, result in run(
            Squares(), [1, ("die once", str(tmp_path / "mark")), "die", *range(2, 9)], on_cluster,
            name=lambda unit: f"unit {unit!r}", units_per_worker=4,
        ):  # fmt: skip
            results.append((unit, result))
    assert sorted(result for _, result in results) == [0, *(number**2 for number in range(1, 9))]


def test_mistakes_and_defects_are_those_of_the_local_engine(on_cluster):
    with pytest.raises(UserError) as raised:
        list(run(Squares(), ["mistake"], on_cluster))
    assert raised.value.message == "--size: a mistake of the user's; choose another"
    with pytest.raises(RuntimeError, match=r"(?s)unit defect failed.*in square.*ZeroDivisionError: deep in a worker"):
        list(run(Squares(), ["defect"], on_cluster, name=lambda unit: f"unit {unit}"))


@pytest.mark.parametrize("named", ["absolute", "relative to the caller's working folder"])
def test_a_node_elsewhere_reads_its_own_copy_of_a_folder(on_cluster, tmp_path, monkeypatch, named):
    monkeypatch.chdir(tmp_path)  # that of nobody else in the cluster
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "a").write_text(f"content {time.time()}")
    given = folder if named == "absolute" else Path("folder")
    places = set()
    results = run(ReadsFolder(given), ["a"] * 200, on_cluster)
    for _, (place, text, _) in results:
        assert text == (folder / "a").read_text()
        places.add(place)
        if len(places) == 2:  # a node may begin late
            break
    results.close()
    assert str(folder) in places and len(places) == 2


def test_a_collection_whose_node_is_killed_in_the_middle_gives_the_bytes_of_the_local_engine(
    cluster, on_cluster, regular_objects
):
    settings = CollectionSettings(block_size=2)
    work = Collection(TASKS["regular"].settings.to_json(), regular_objects.folder, settings)
    blocks = [Block(number, 2, 2 * number) for number in range(10)]
    found = {}
    for block, episodes in collected(work, blocks, on_cluster):
        found[block] = episodes
        if len(found) == 3:
            cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)
    expected = dict(collected(work, blocks, EngineSettings(workers=0)))
    assert {block: contents(episodes) for block, episodes in found.items()} == {
        block: contents(episodes) for block, episodes in expected.items()
    }


def test_an_evaluation_whose_node_is_killed_in_the_middle_gives_the_rows_of_the_local_engine(
    cluster, on_cluster, regular_objects
):
    cluster.add_node(num_cpus=1)
    work = Rollouts(Scenes(TASKS["regular"], regular_objects.folder, "test", 0), RandomPolicy())
    seen = []

    def kill_one(row):
        seen.append(row)
        if len(seen) == 4:
            cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)

    rows, films = run_rollouts(work, 16, on_cluster, films=2, on_row=kill_one)
    expected, expected_films = run_rollouts(work, 16, EngineSettings(workers=0), films=2)
    assert rows == expected and len(seen) == 16
    assert [film.frames.tobytes() for film in films] == [film.frames.tobytes() for film in expected_films]


def contents(episodes):
    return [
        {name: value.tobytes() if hasattr(value, "tobytes") else value for name, value in vars(episode).items()}
        for episode in episodes
    ]


@pytest.mark.parametrize("address", ["127.0.0.1:1", "ray://nowhere", "nonsense"])
def test_an_address_without_a_cluster_is_one_line(address):
    with pytest.raises(UserError, match=rf"--ray-address: no cluster at '{address}'.*expected HOST:PORT or auto"):
        list(run(Squares(), [1], EngineSettings(engine="ray", ray_address=address)))


def test_nothing_is_left_of_a_ray_whose_process_is_killed(tmp_path_factory):
    end_in_the_middle("ray", signal.SIGKILL, tmp_path_factory.mktemp("r"))
