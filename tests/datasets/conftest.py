"""Real shards of drawn episodes."""

import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

# For `drawn_data`, which holds no tests.
sys.path.append(str(Path(__file__).parent))
from drawn_data import FIVE_PARTS, LIMITS, make_dataset, make_episode, make_episodes, make_manifest


@pytest.fixture(scope="session")
def drawn() -> SimpleNamespace:
    """The helpers of `drawn_data`."""
    return SimpleNamespace(
        manifest=make_manifest,
        five_parts=FIVE_PARTS,
        episode=make_episode,
        episodes=make_episodes,
        dataset=make_dataset,
        limits=LIMITS,
    )


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of 12 blocks in 3 shards, to read only."""
    folder = tmp_path_factory.mktemp("data") / "drawn"
    make_dataset(folder)
    return folder


@pytest.fixture(scope="session")
def many_blocks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of 200 blocks of four episodes in 4 shards, to read only."""
    folder = tmp_path_factory.mktemp("data") / "many"
    make_dataset(folder, blocks=200, per_shard=50, block_size=4)
    return folder


@pytest.fixture
def new_dataset(tmp_path: Path) -> Callable[..., Path]:
    """Make a dataset that the test may damage."""

    def make(name: str = "made", **options: float) -> Path:
        make_dataset(tmp_path / name, **options)  # type: ignore[arg-type]
        return tmp_path / name

    return make
