"""A small but real world: procedural objects, grasps from the simulator in a dataset, and a run trained on it."""

import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")

BLOCKS, BLOCK_SIZE = 4, 3


@pytest.fixture(scope="session")
def objects_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from graspq.objects.procedural import make_procedural

    folder = tmp_path_factory.mktemp("objects") / "regular"
    make_procedural(folder, seed=0, train=6, test=6)
    return folder


@pytest.fixture(scope="session")
def dataset(objects_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Grasps of the random policy, collected and written as grasp-datagen does, with the object set beside them."""
    from graspq.datagen.collect import collect_block
    from graspq.datagen.settings import CollectionSettings
    from graspq.datasets.manifest import Manifest
    from graspq.datasets.writer import commit_shard, write_shard
    from graspq.objects.object_set import ObjectSet
    from graspq.sim.episode import GraspSimulation
    from graspq.sim.task import task_settings

    folder = tmp_path_factory.mktemp("data") / "regular"
    objects, task = ObjectSet.load(objects_folder), task_settings("regular")
    settings = replace(CollectionSettings(), block_size=BLOCK_SIZE)
    manifest = Manifest(
        task=task.to_json(),
        settings=settings.described(),
        versions={},
        object_set={"name": objects.name, "sha256": objects.digest()},
        image_shape=(task.image_size, task.image_size, 3),
        action_limits=task.action_limits,
        discount=1.0,
        phi_range=(-task.phi_limit, task.phi_limit),
    )
    objects.copy_to(folder / "objects")
    with GraspSimulation(task, objects) as simulation:
        blocks = [collect_block(simulation, settings, block, BLOCK_SIZE) for block in range(BLOCKS)]
    episodes = [episode for block in blocks for episode in block]
    manifest.save(folder)
    commit_shard(folder, manifest, write_shard(folder, manifest, 0, BLOCKS, episodes))
    return folder


@pytest.fixture(scope="session")
def run_folder(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of `mc` with the paper's network, four steps long, with two validations and two checkpoints."""
    from graspq.train.loop import train
    from graspq.train.settings import preset_settings

    folder = tmp_path_factory.mktemp("runs") / "mc"
    settings = preset_settings(
        "paper", algo="mc", shards=(str(dataset),), out=folder, steps=4, batch_size=8, log_every=1,
        validate_every=2, checkpoint_every=2, validation_fraction=0.25, device="cpu", precision="float32", threads=1,
    )  # fmt: skip
    train(settings)
    return folder


@pytest.fixture
def command(capfd: pytest.CaptureFixture[str]) -> "Command":
    return Command(capfd)


class Command:
    """Runs a console script's function in this process; gives exit status and what it printed."""

    def __init__(self, capfd: pytest.CaptureFixture[str]) -> None:
        self._capfd = capfd

    def __call__(self, name: str, *arguments: str | Path) -> SimpleNamespace:
        from graspq.evaluate.cli import main as grasp_eval
        from graspq.evaluate.report_cli import main as grasp_report

        main = {"grasp-eval": grasp_eval, "grasp-report": grasp_report}[name]
        self._capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in arguments], prog_name=name)
        out, err = self._capfd.readouterr()
        return SimpleNamespace(code=ended.value.code, out=out, err=err, lines=err.strip().splitlines())
