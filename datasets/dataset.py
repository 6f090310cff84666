"""Opens datasets and pools of shards, checking every file against its manifest before anything is read from it."""

import hashlib
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from graspq.common.errors import UserError
from graspq.common.files import sha256_of
from graspq.datasets.blocks import REMEDY, BlockRef, read_episode_rows
from graspq.datasets.manifest import MANIFEST_NAME, Manifest, ShardEntry, episodes_file, steps_file
from graspq.datasets.pool import ShardPool

HASHING_THREADS = 4


@dataclass(frozen=True)
class Dataset:
    """A dataset folder and its manifest."""

    folder: Path
    manifest: Manifest

    @classmethod
    def open(cls, folder: Path | str) -> "Dataset":
        """Return the dataset in `folder`; its files are checked when they are read.

        Raises:
            UserError: the folder is no dataset, or its manifest is damaged.
        """
        return cls(Path(folder), Manifest.load(Path(folder)))

    def pool(self, verify: bool = True) -> ShardPool:
        """Return all its shards; see `open_shards`."""
        return _pool([(self, entry) for entry in self.manifest.shards], str(self.folder), verify)

    def shard_pool(self, entry: ShardEntry, verify: bool = True) -> ShardPool:
        """Return one of its shards as a pool; see `open_shards`."""
        return _pool([(self, entry)], str(self.folder), verify)

    def episode_rows(self, entry: ShardEntry, verify: bool = True) -> list[dict[str, Any]]:
        """Return the rows of a shard's episodes table, columns as in `columns.EPISODES`.

        Raises:
            UserError: the file is missing or damaged.
        """
        path = episodes_file(entry.name)
        check_file(self.folder, entry, path, verify)
        return read_episode_rows(self.folder / path)


def open_shards(patterns: Sequence[str | Path], verify: bool = True) -> ShardPool:
    """Return the pool of all shards that the patterns name; a shard named twice counts once.

    Args:
        patterns: dataset folders, steps tables (`<dataset>/shards/*.parquet`), and globs of either.
        verify: check the SHA-256 of every file now, besides its size; page checksums are verified on each read anyway.

    Raises:
        UserError: a pattern matches nothing, something is no dataset or is damaged, or datasets do not fit together.
    """
    if not patterns:
        raise UserError("--shards: expected dataset folders, shard files or globs, got none")
    found: dict[tuple[str, int], tuple[Dataset, ShardEntry]] = {}
    opened: dict[Path, Dataset] = {}
    for pattern in patterns:
        for path in _matches(str(pattern)):
            for dataset, entry in _entries(path, opened):
                # By content: a copy of a shard under another name is the same shard.
                found.setdefault((entry.files[steps_file(entry.name)], entry.first_block), (dataset, entry))
    return _pool(list(found.values()), " ".join(map(str, patterns)), verify)


def check_file(folder: Path, entry: ShardEntry, path: str, verify: bool) -> None:
    """Check one file of a shard against the manifest: its size, and its SHA-256 where `verify` says so.

    Raises:
        UserError: the file is missing, of another size, or of other content.
    """
    full = folder / path
    try:
        size = full.stat().st_size
    except OSError as error:
        raise UserError(f"{full}: listed in the manifest but cannot be opened ({error.strerror}); {REMEDY}") from None
    if size != entry.sizes[path]:
        what = "truncated" if size < entry.sizes[path] else "too long"
        raise UserError(f"{full}: {what}, {size} bytes instead of {entry.sizes[path]}; {REMEDY}")
    if verify and sha256_of(full) != entry.files[path]:
        raise UserError(f"{full}: damaged, its SHA-256 is not that of the manifest; {REMEDY}")


def _matches(pattern: str) -> list[Path]:
    path = Path(pattern).expanduser()
    if path.exists():
        return [path]
    root = Path(path.anchor) if path.is_absolute() else Path()
    matches = sorted(root.glob(str(path.relative_to(path.anchor) if path.is_absolute() else path)))
    if not matches:
        raise UserError(f"--shards: {pattern}: no such folder or file; expected a dataset folder, a shard or a glob")
    return matches


def _entries(path: Path, opened: dict[Path, Dataset]) -> Iterable[tuple[Dataset, ShardEntry]]:
    if path.is_file():
        folder = path.absolute().parent.parent
    elif path.absolute().name == "shards" and not (path / MANIFEST_NAME).is_file():
        folder = path.absolute().parent
    else:
        folder = path
    key = folder.resolve()
    if key not in opened:
        opened[key] = Dataset.open(folder)
    dataset = opened[key]
    if path.is_dir():
        return [(dataset, entry) for entry in dataset.manifest.shards]
    inside = f"{path.absolute().parent.name}/{path.name}"
    listed = [entry for entry in dataset.manifest.shards if steps_file(entry.name) == inside]
    if not listed:
        raise UserError(f"{path}: not a shard of {folder}: its manifest does not list {inside} as a steps table")
    return [(dataset, listed[0])]


def _pool(found: list[tuple[Dataset, ShardEntry]], named: str, verify: bool) -> ShardPool:
    if not found:
        raise UserError(f"{named}: the dataset has no finished shard yet; run the command that makes it again")
    found = sorted(found, key=lambda pair: (_seed(pair[0]), pair[1].first_block, sorted(pair[1].files.values())))
    _check_agreement([dataset for dataset, _ in found])
    with ThreadPoolExecutor(HASHING_THREADS) as executor:
        list(executor.map(lambda pair: check_file(pair[0].folder, pair[1], steps_file(pair[1].name), verify), found))
    footers = {dataset.folder / steps_file(entry.name): _footer(dataset, entry) for dataset, entry in found}
    manifest = found[0][0].manifest
    whole = len(found) == len(manifest.shards) and len({id(dataset) for dataset, _ in found}) == 1
    digests = "".join(entry.files[steps_file(entry.name)] for _, entry in found)
    return ShardPool(
        blocks=tuple(ref for dataset, entry in found for ref in _refs(dataset, entry, footers)),
        task=manifest.task,
        image_shape=manifest.image_shape,
        action=manifest.action,
        discount=manifest.discount,
        object_set=manifest.object_set,
        manifest_digest=manifest.digest() if whole else hashlib.sha256(digests.encode()).hexdigest(),
        _footers=footers,
    )


def _footer(dataset: Dataset, entry: ShardEntry) -> Any:
    path = dataset.folder / steps_file(entry.name)
    try:
        footer = pq.read_metadata(path)
    except (OSError, pa.ArrowException, ValueError) as error:
        raise UserError(f"{path}: not a readable Parquet file ({_one_line(error)}); {REMEDY}") from None
    if footer.num_row_groups != entry.blocks or footer.num_rows != entry.rows:
        raise UserError(
            f"{path}: expected {entry.blocks} blocks with {entry.rows} rows, "
            f"got {footer.num_row_groups} with {footer.num_rows}; {REMEDY}"
        )
    return footer


def _refs(dataset: Dataset, entry: ShardEntry, footers: dict[Path, Any]) -> list[BlockRef]:
    path = dataset.folder / steps_file(entry.name)
    size = dataset.manifest.block_size
    return [
        BlockRef(
            path=path,
            row_group=index,
            block=block,
            rows=footers[path].row_group(index).num_rows,
            episodes=min(size, entry.episodes - index * size),
            key=f"{dataset.manifest.task_name}/{_seed(dataset)}/{block}",
        )
        for index, block in enumerate(entry.block_range)
    ]


def _check_agreement(datasets: list[Dataset]) -> None:
    first = datasets[0]
    for other in datasets[1:]:
        theirs = _agreed(other.manifest)
        for what, ours in _agreed(first.manifest).items():
            if ours != theirs[what]:
                raise UserError(
                    f"--shards: cannot mix {what}: {first.folder} has {_shown(ours, theirs[what])}, "
                    f"{other.folder} has {_shown(theirs[what], ours)}; train on one of them"
                )


def _agreed(manifest: Manifest) -> dict[str, Any]:
    """Return what datasets must have in common to be trained on together."""
    return {
        "tasks": manifest.task_name,
        "simulator versions": manifest.task.get("simulator_version"),
        "task settings": manifest.task,
        "image shapes": manifest.image_shape,
        "action limits": manifest.action_limits,
        "action spaces": manifest.action.to_json(),
        "discounts": manifest.discount,
        "object sets": f"{manifest.object_set.get('name')} ({str(manifest.object_set.get('sha256'))[:16]})",
        "collection splits": manifest.settings.get("split"),
    }


def _shown(value: Any, other: Any) -> str:
    """Say what a dataset has; of many settings only those that differ from the other dataset's."""
    if isinstance(value, dict):
        return ", ".join(
            f"{name} = {value.get(name)}" for name in {**value, **other} if value.get(name) != other.get(name)
        )
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _seed(dataset: Dataset) -> str:
    return str(dataset.manifest.settings.get("seed", ""))


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())
