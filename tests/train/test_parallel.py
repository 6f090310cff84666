"""Two ranks learn together what one process learns, where nothing depends on the parts of a batch but their mean."""

import os
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from graspq.common.errors import UserError
from graspq.train.checkpoint import load_acting
from graspq.train.loop import train
from graspq.train.parallel import ALONE, Ranks, joined
from graspq.train.run import Run
from graspq.train.settings import complete

# The paper's network has no batch statistics; without augmentation a rank's random numbers decide nothing for `mc`.
PLAIN = {
    "network": "paper",
    "shift": 0,
    "mirror": False,
    "color": 0,
    "precision": "float32",
    "steps": 4,
    "batch_size": 32,
}


def torchrun(*words: str, folder: Path) -> subprocess.CompletedProcess[str]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    start = [str(Path(sys.executable).with_name("torchrun")), "--no-python", "--nproc-per-node", "2"]
    command = [*start, "--master-port", str(port), str(Path(sys.executable).with_name("grasp-train")), *words]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(
        command, capture_output=True, text=True, cwd=folder, env=environment, timeout=300, check=False
    )


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, two_states: SimpleNamespace) -> SimpleNamespace:
    """The same training by two ranks and by one process."""
    folder = tmp_path_factory.mktemp("ranks")
    shards = str(two_states.dataset(folder / "data", 20))
    words = ["--algo", "mc", "--shards", shards, "--out", "two", "--network", "paper", "--shift", "0", "--no-mirror"]
    words += ["--color", "0"]
    done = torchrun(*words, "--precision", "float32", "--steps", "4", "--batch-size", "32", folder=folder)
    assert done.returncode == 0, done.stderr
    given = PLAIN | {"algo": "mc", "shards": (shards,), "out": folder / "one", "threads": 1}
    return SimpleNamespace(folder=folder, shards=shards, done=done, one=train(complete(given)))


def test_two_ranks_end_in_the_weights_of_one_process_up_to_rounding(trained: SimpleNamespace) -> None:
    one, two = (load_acting(trained.folder / name).networks["q"].state_dict() for name in ("one", "two"))
    start = complete(PLAIN | {"algo": "mc", "shards": (trained.shards,), "out": trained.folder / "start", "steps": 1})
    first = load_acting(train(start).folder).networks["q"].state_dict()
    for name, weight in one.items():
        torch.testing.assert_close(two[name], weight, rtol=0, atol=2e-5)
    assert max(float((one[name] - first[name]).abs().max()) for name in one) > 1e-3, "the bound is tight beside a step"


def test_the_first_rank_alone_writes_and_speaks(trained: SimpleNamespace) -> None:
    assert trained.done.stdout.count("step 4, loss") == 1 and trained.done.stderr.count("mc: two") == 1
    run = Run.open(trained.folder / "two")
    assert [row["step"] for row in run.metrics()] == [4, 4], "one row of training and one of validation"
    assert len(list((run.folder / "tensorboard").iterdir())) == 1


def test_a_mistake_ends_both_ranks_with_its_line(trained: SimpleNamespace) -> None:
    done = torchrun("--algo", "mc", "--shards", trained.shards, "--out", "data", folder=trained.folder)
    assert done.returncode != 0
    assert done.stderr.count("not empty and not a training run") == 2, done.stderr


def test_one_process_is_alone_and_changes_nothing() -> None:
    with joined() as ranks:
        assert ranks == ALONE and ranks.first
        assert ranks.any(True) and not ranks.any(False)
        network = torch.nn.Linear(2, 1)
        optimizer = torch.optim.SGD(network.parameters(), lr=1.0)
        ranks.attach(network, optimizer)
        assert not optimizer._optimizer_step_pre_hooks
    assert not Ranks(1, 2).first


def test_a_mistake_found_by_the_first_rank_is_raised_as_it_is_when_alone() -> None:
    def wrong() -> None:
        raise UserError("--out: no")

    with pytest.raises(UserError, match="--out: no"):
        ALONE.from_first(wrong)
