"""The short form of `make faults`: a few faults of most kinds, in at most a minute."""

from collections.abc import Iterator

import pytest

from tests.faults.harness import GOOD, Kind, Work
from tests.faults.kinds import KINDS
from tests.faults.planted import PLANTED, source_with
from tests.faults.system_calls import shim


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Work]:
    folder = tmp_path_factory.mktemp("faults")
    with Work(folder, shim=shim(folder)) as made:
        yield made


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_nothing_is_lost_or_silently_wrong(kind: Kind, work: Work) -> None:
    for fault in kind.faults(work, short=True):
        tried = kind.tried(fault, work)
        assert tried.outcome in GOOD, (fault, tried)


@pytest.mark.parametrize("planted", PLANTED, ids=lambda planted: planted.name)
def test_the_place_of_every_planted_defect_is_still_there(planted: object, tmp_path: object) -> None:
    source_with(planted, tmp_path)  # type: ignore[arg-type]
