"""The short form of `make faults`: a few faults of most kinds, in at most a minute."""

import random
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path

import pytest

from tests.faults.commands import difference, rows_differ, with_checkpoints_of
from tests.faults.harness import GOOD, CommittedWork, Kind, NotHereError, Work
from tests.faults.kinds import KINDS
from tests.faults.planted import PLANTED, source_with
from tests.faults.power_loss import KEPT, LOST, WAYS, Committed, Disk
from tests.faults.system_calls import CREATE, FSYNC, REMOVE, RENAME, WRITE, Call, shim


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Work]:
    folder = tmp_path_factory.mktemp("faults")
    with Work(folder, shim=shim(folder)) as made:
        yield made


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_nothing_is_lost_or_silently_wrong(kind: Kind, work: Work) -> None:
    try:
        faults = list(kind.faults(work, short=True))
    except NotHereError as reason:
        pytest.skip(str(reason))
    for fault in faults:
        tried = kind.tried(fault, work)
        assert tried.outcome in GOOD, (fault, tried)


@pytest.mark.parametrize("planted", PLANTED, ids=lambda planted: planted.name)
def test_the_place_of_every_planted_defect_is_still_there(planted: object, tmp_path: object) -> None:
    source_with(planted, tmp_path)  # type: ignore[arg-type]


def _run(*steps: int, weights: str = "w") -> dict[str, str]:
    return {f"runs/mc/checkpoints/step-{step:08d}/{name}": weights for step in steps for name in ("q", "kept")}


def _without(end: str, run: dict[str, str]) -> dict[str, str]:
    return {name: weights for name, weights in run.items() if not name.endswith(end)}


@pytest.mark.parametrize(
    ("interrupted", "differs"),
    [
        # An unbroken run keeps 4, 6, 8 of its 2, 4, 6, 8.
        (_run(4, 6, 8), None),
        (_run(5, 6, 8), None),
        (_run(6, 7, 8), None),
        (_run(5, 6, 7), "step-00000007/kept is there and should not be"),
        (_run(2, 4, 6), "step-00000008/kept is missing"),
        (_run(5, 6) | _run(8, weights="others"), "step-00000008/kept is another"),
        (_without("6/kept", _run(5, 6, 8)), "step-00000006/kept is missing"),
        (_run(6, 8), "runs/mc/checkpoints is another"),
    ],
)
def test_checkpoints_of_an_interrupted_run_are_compared_where_an_unbroken_run_has_them(
    interrupted: dict[str, str], differs: str | None
) -> None:
    unbroken = _run(4, 6, 8)
    found = difference(with_checkpoints_of(interrupted, unbroken), with_checkpoints_of(unbroken, interrupted))
    assert found is None if differs is None else differs in (found or "")


def _row(step: int, loss: float = 1.0) -> dict[str, object]:
    return {"step": step, "loss": loss}


@pytest.mark.parametrize(
    ("interrupted", "differs"),
    [
        ([_row(2), _row(4)], None),
        ([_row(2), _row(3, 5.0), _row(4, 6.0)], None),
        ([_row(1, 5.0), _row(2, 6.0), _row(4)], None),
        ([_row(2), _row(4, 2.0)], "its row of the steps (2, 4)"),
        ([_row(2), _row(2), _row(4)], "its steps are [2, 2, 4]"),
        ([_row(2), _row(3)], "its steps are [2, 3]"),
        ([{"step": 4, "validation": {}}, _row(4)], "its validations"),
    ],
)
def test_rows_of_an_interrupted_run_are_compared_where_their_bounds_are_those_of_an_unbroken_run(
    interrupted: list[dict[str, object]], differs: str | None
) -> None:
    found = rows_differ(interrupted, [_row(2), _row(4)])
    assert found is None if differs is None else differs in (found or "")


def test_work_that_is_whole_must_be_kept_and_not_made_again(tmp_path: Path) -> None:
    whole = {"a/shards/x.parquet": "shard", "b/checkpoints/step-00000002/state.json": "state", "c/eval.json": "eval"}
    for name, content in (whole | {"a/manifest.json": '{"shards/x.parquet": 0}'}).items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(content)
    committed = CommittedWork(tmp_path, {name: sha256(content.encode()).hexdigest() for name, content in whole.items()})
    assert committed.lost() is None
    for name, content in whole.items():
        kept = tmp_path / "kept"
        (tmp_path / name).rename(kept)
        (tmp_path / name).write_text(content)
        lost = committed.lost()
        assert lost is not None and lost.outcome == "lost" and name in lost.said
        kept.rename(tmp_path / name)
    # What no manifest lists yet is not committed.
    (tmp_path / "a/manifest.json").write_text("{}")
    assert CommittedWork(tmp_path, {"a/shards/x.parquet": sha256(b"shard").hexdigest()}).names == set()


def _commit(content: bytes) -> list[Call]:
    """Return the calls that put a file in the place of another."""
    return [
        Call(CREATE, False, 0, "new", "", b""),
        Call(WRITE, False, 0, "new", "", content),
        Call(FSYNC, False, 0, "new", "", b""),
        Call(RENAME, False, 0, "new", "file", b""),
        Call(FSYNC, False, 0, "", "", b""),
    ]


def _replayed(calls: list[Call], start: Path) -> tuple[Disk, Committed]:
    disk = Disk(start)
    committed = Committed(disk)
    for call in calls:
        disk.do(call)
        committed.see(call)
    return disk, committed


@pytest.mark.parametrize("way", WAYS)
def test_a_committed_file_may_be_the_old_or_the_new_one_until_its_folder_is_synced(way: str, tmp_path: Path) -> None:
    disk, committed = _replayed([*_commit(b"old"), *_commit(b"new")[:4]], tmp_path)
    assert committed.missing(disk.left(way, random.Random(0))) is None
    disk, committed = _replayed([*_commit(b"old"), *_commit(b"new")], tmp_path)
    assert committed.files == {"file": b"new"}
    assert committed.missing(disk.left(way, random.Random(0))) is None


def test_a_committed_file_that_is_not_there_is_missing(tmp_path: Path) -> None:
    _, committed = _replayed(_commit(b"old"), tmp_path)
    assert committed.missing(Disk(tmp_path).left(LOST, random.Random(0))) == "file"
    _, committed = _replayed([*_commit(b"old"), Call(REMOVE, False, 0, "file", "", b"")], tmp_path)
    assert committed.missing(Disk(tmp_path).left(KEPT, random.Random(0))) is None
