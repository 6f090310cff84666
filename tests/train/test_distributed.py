"""Two ranks learn what one process learns: the same samples bit by bit, the same loss within a bound."""

import json
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import ranks_worker
import torch

from graspq.common.errors import UserError
from graspq.train.distributed import ALONE, BatchPart, Ranks, joined
from graspq.train.run import Run, Witness
from graspq.train.settings import TrainSettings

ALGOS = ("dql", "corr-mc", "ddpg", "pcl", "blend")
# One step differs by rounding. AdamW divides a gradient by its own size, and makes much of what is rounding in it.
FIRST_LOSS, LATER_LOSS = 1e-6, 1e-4


def torchrun(*command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    start = [str(Path(sys.executable).with_name("torchrun")), "--no-python", "--nproc-per-node", "2"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [*start, "--master-port", str(port), *command],
        capture_output=True,
        text=True,
        cwd=folder,
        env=environment,
        timeout=300,
    )


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, two_states: SimpleNamespace) -> SimpleNamespace:
    """The same trainings by two ranks and by one process."""
    folder = tmp_path_factory.mktemp("ranks")
    shards = str(two_states.dataset(folder / "data", 20))
    one, two = folder / "one", folder / "two"
    for made in (one, two):
        made.mkdir()
    worker = [sys.executable, "-P", str(Path(ranks_worker.__file__))]
    done = torchrun(*worker, str(two), shards, *ALGOS, folder=folder)
    assert done.returncode == 0, done.stderr
    ranks_worker.train_all(one, shards, list(ALGOS), ALONE)
    return SimpleNamespace(one=one, two=two, folder=folder, shards=shards)


def losses(run: Path) -> torch.Tensor:
    rows = Run.open(run).metrics()
    assert [row["step"] for row in rows if "loss" in row] == [1, 2, 3, 4], "each step once: one rank alone writes"
    return torch.tensor([row["loss"] for row in rows if "loss" in row], dtype=torch.float64)


@pytest.mark.parametrize("algo", ALGOS)
def test_the_parts_of_two_ranks_are_the_samples_of_one_process_augmented_alike(
    trained: SimpleNamespace, algo: str
) -> None:
    one = json.loads((trained.one / f"{algo}-0.json").read_text())
    parts = [json.loads((trained.two / f"{algo}-{rank}.json").read_text()) for rank in (0, 1)]
    assert [first + second for first, second in zip(*parts, strict=True)] == one
    assert all(first and second for first, second in zip(*parts, strict=True))


@pytest.mark.parametrize("algo", ALGOS)
def test_two_ranks_have_the_loss_of_one_process_at_each_step(trained: SimpleNamespace, algo: str) -> None:
    one, two = losses(trained.one / "unbroken" / algo), losses(trained.two / "unbroken" / algo)
    difference = (one - two).abs()
    assert float(difference[0]) <= FIRST_LOSS and float(difference.max()) <= LATER_LOSS, difference.tolist()
    assert float(one.max() - one.min()) > 100 * LATER_LOSS, "the bound is tight beside what the steps change"


@pytest.mark.parametrize("algo", ALGOS)
def test_two_ranks_that_were_stopped_and_started_again_end_in_the_same_bits(
    trained: SimpleNamespace, algo: str
) -> None:
    ends = [Run.open(trained.two / run / algo).checkpoint(ranks_worker.STEPS) for run in ("unbroken", "broken")]
    names = [sorted(path.name for path in end.iterdir()) for end in ends]
    assert names[0] == names[1] and "state.json" in names[0]
    assert all((ends[0] / name).read_bytes() == (ends[1] / name).read_bytes() for name in names[0])


def test_a_run_of_two_ranks_can_be_taken_up_by_one(trained: SimpleNamespace) -> None:
    out = trained.two / "broken" / "dql"
    ranks_worker.train_until(6, out, trained.shards, "dql", ALONE)
    assert Run.open(out).checkpoint().name == "step-00000006"


def test_the_command_runs_on_ranks_and_the_first_alone_writes_and_speaks(trained: SimpleNamespace) -> None:
    command = ["grasp-train", "--algo", "mc", "--shards", trained.shards, "--out", "run", "--steps", "3"]
    command += ["--batch-size", "30", "--device", "cpu", "--precision", "float32", "--log-every", "1"]
    command[0] = str(Path(sys.executable).with_name("grasp-train"))
    done = torchrun(*command, folder=trained.folder)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("step 3, loss") == 1 and done.stderr.count("mc: run") == 1
    run = Run.open(trained.folder / "run")
    assert [row["step"] for row in run.metrics()] == [1, 2, 3, 3], "three losses and one validation"
    assert len(list((run.folder / "tensorboard").iterdir())) == 1


def test_one_process_is_alone_and_changes_nothing() -> None:
    values = torch.tensor([1.0, 2.0])
    with joined("cpu") as ranks:
        assert ranks == ALONE and ranks.first
        assert ranks.sum(values) is values
        assert ranks.any(True) and not ranks.any(False)
        part = BatchPart.of(ranks, 7, torch.tensor(7))
    assert part.mean(values) is values and part.share == 1.0
    assert part.draw(3, lambda rows: torch.arange(rows)).tolist() == [0, 1, 2]


@pytest.mark.parametrize(("rows", "count"), [(31, 2), (8, 4), (5, 4)])
def test_the_draws_of_all_parts_together_are_those_of_the_whole_batch(rows: int, count: int) -> None:
    sizes = [len(part) for part in torch.tensor_split(torch.arange(rows), count)]
    parts = [BatchPart(Ranks(rank, count), rows) for rank in range(count)]
    drawn = [part.draw(size, lambda number: torch.arange(number)) for part, size in zip(parts, sizes, strict=True)]
    assert torch.cat(drawn).tolist() == list(range(rows))


def test_a_witness_of_a_run_leaves_its_folder_as_it_is(settings: Callable[..., TrainSettings], tmp_path: Path) -> None:
    run = Run.create_or_resume(tmp_path / "run", {"settings": settings().to_json()})
    run.append_metrics({"step": 1, "loss": 1.0})
    before = {path: path.read_bytes() for path in run.folder.rglob("*") if path.is_file()}
    witness = Witness(run.folder, dict(run.config))
    witness.append_metrics({"step": 2, "loss": 2.0})
    witness.note("precision", {"name": "float32"})
    witness.forget_after(0)
    witness.prune(1)
    assert witness.config["precision"] == {"name": "float32"}
    assert {path: path.read_bytes() for path in run.folder.rglob("*") if path.is_file()} == before


def test_a_mistake_found_by_the_first_rank_is_raised_as_it_is_when_alone() -> None:
    def wrong() -> None:
        raise UserError("--out: no")

    with pytest.raises(UserError, match="--out: no"):
        ALONE.from_first(wrong)
