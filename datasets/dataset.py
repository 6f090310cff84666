"""Opens datasets as a pool of shards, checking every file against its manifest before anything is read from it."""

import hashlib
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from graspq.common.errors import UserError, told
from graspq.common.files import sha256_of
from graspq.common.text import bytes_text
from graspq.datasets.blocks import REMEDY, BlockRef, read_episode_rows, readable
from graspq.datasets.columns import record_dtype
from graspq.datasets.manifest import MANIFEST_NAME, Manifest, ShardEntry, episodes_file, steps_file
from graspq.datasets.pool import ShardPool
from graspq.datasets.tables import episodes_schema, steps_schema

HASHING_THREADS = 4
LARGEST_BLOCK = 4 * 10**9  # bytes in memory


@dataclass(frozen=True)
class Shard:
    """A shard where it lies.

    Attributes:
        folder: the dataset.
        manifest: its manifest.
        entry: what the manifest says of the shard.
    """

    folder: Path
    manifest: Manifest
    entry: ShardEntry

    @classmethod
    def all_of(cls, folder: Path) -> list["Shard"]:
        """Return the shards of a dataset.

        Raises:
            UserError: the folder is no dataset, or its manifest is damaged.
        """
        manifest = Manifest.load(folder)
        return [cls(folder, manifest, entry) for entry in manifest.shards]

    @property
    def steps(self) -> Path:
        """Its steps table."""
        return self.folder / steps_file(self.entry.name)

    @property
    def episodes(self) -> Path:
        """Its episodes table."""
        return self.folder / episodes_file(self.entry.name)

    @property
    def may_grow(self) -> bool:
        """Whether a larger dataset in the same folder would replace it: the last one, if it is not whole."""
        whole = int(self.manifest.settings.get("blocks_per_shard", 0)) * self.manifest.block_size
        return self.entry == self.manifest.shards[-1] and self.entry.episodes < whole

    def content(self) -> bytes:
        """Return the bytes of its steps table.

        Raises:
            UserError: it is missing or damaged.
        """
        with readable(f"{self.steps}:"):
            content = self.steps.read_bytes()
        if hashlib.sha256(content).hexdigest() != self.entry.files[steps_file(self.entry.name)]:
            raise UserError(f"{self.steps}: damaged, its SHA-256 is not that of the manifest; {REMEDY}")
        return content

    def check(self, path: Path, verify: bool = True) -> None:
        """Check one of its two files against the manifest: its size, and its SHA-256 where `verify` says so.

        Raises:
            UserError: the file is missing, of another size, or of other content.
        """
        name = path.relative_to(self.folder).as_posix()
        try:
            size, expected = path.stat().st_size, self.entry.sizes[name]
        except OSError as error:
            raise told(
                error, f"{path}: listed in the manifest but cannot be opened ({error.strerror}); {REMEDY}"
            ) from None
        if size != expected:
            what = "truncated" if size < expected else "too long"
            raise UserError(f"{path}: {what}, {size} bytes instead of {expected}; {REMEDY}")
        if verify and sha256_of(path) != self.entry.files[name]:
            raise UserError(f"{path}: damaged, its SHA-256 is not that of the manifest; {REMEDY}")

    def episode_rows(self, verify: bool = True) -> list[dict[str, Any]]:
        """Return the rows of its episodes table, columns as in `columns.EPISODES`.

        Raises:
            UserError: the file is missing or damaged.
        """
        self.check(self.episodes, verify)
        with readable(f"{self.episodes}:"):
            footer = pq.read_metadata(self.episodes)
        if footer.num_rows != self.entry.episodes:
            raise UserError(
                f"{self.episodes}: expected {self.entry.episodes} episodes, got {footer.num_rows}; {REMEDY}"
            )
        _check_columns(self.episodes, footer.schema.to_arrow_schema(), episodes_schema(self.manifest))
        return read_episode_rows(self.episodes)

    def footer(self) -> Any:
        """Return the footer of its steps table.

        Raises:
            UserError: it cannot be read, or its blocks are not those of the manifest.
        """
        with readable(f"{self.steps}:"):
            footer = pq.read_metadata(self.steps)
        if footer.num_row_groups != self.entry.blocks or footer.num_rows != self.entry.rows:
            raise UserError(
                f"{self.steps}: expected {self.entry.blocks} blocks with {self.entry.rows} rows, "
                f"got {footer.num_row_groups} with {footer.num_rows}; {REMEDY}"
            )
        _check_columns(self.steps, footer.schema.to_arrow_schema(), steps_schema(self.manifest))
        self._check_blocks(footer)
        return footer

    def _check_blocks(self, footer: Any) -> None:
        """Refuse blocks that no memory holds, whatever the manifest says, before one is read."""
        manifest, rows = self.manifest, [footer.row_group(index).num_rows for index in range(footer.num_row_groups)]
        most = manifest.block_size * int(manifest.task["max_steps"])
        row_bytes = math.prod(manifest.image_shape) + record_dtype(manifest.image_shape, manifest.action).itemsize
        if max(rows) > most or max(rows) * row_bytes > LARGEST_BLOCK:
            raise UserError(
                f"{self.steps}: a block of {max(rows):,} rows ({bytes_text(max(rows) * row_bytes)}), expected at most "
                f"{most:,} and {bytes_text(LARGEST_BLOCK)}; {REMEDY}"
            )

    def blocks(self, footer: Any) -> list[BlockRef]:
        """Return where its blocks are."""
        size = self.manifest.block_size
        return [
            BlockRef(
                path=self.steps,
                row_group=index,
                block=block,
                rows=footer.row_group(index).num_rows,
                episodes=min(size, self.entry.episodes - index * size),
                key=f"{self.manifest.task_name}/{self.manifest.seed}/{block}",
            )
            for index, block in enumerate(self.entry.block_range)
        ]


def _check_columns(path: Path, found: Any, expected: Any) -> None:
    for field in expected:
        index = found.get_field_index(field.name)
        if index < 0 or not found.field(index).equals(field):
            there = found.field(index) if index >= 0 else "missing"
            raise UserError(f"{path}: column {field.name}: expected {field}, got {there}; {REMEDY}")


def open_shards(patterns: Sequence[str | Path], verify: bool = True) -> ShardPool:
    """Return the pool of all shards that the patterns name; a shard named twice counts once.

    Args:
        patterns: dataset folders, steps tables (`<dataset>/shards/*.parquet`), and globs of either.
        verify: check the SHA-256 of every file now, besides its size; page checksums are verified on each read anyway.

    Raises:
        UserError: a pattern matches nothing, something is no dataset or is damaged, or datasets do not fit together.
    """
    if not patterns:
        raise UserError("shards: expected dataset folders, shard files or globs, got none")
    while True:
        opened: dict[Path, list[Shard]] = {}
        try:
            return _opened(patterns, verify, opened)
        except UserError:
            # A dataset that is being extended loses its last shard to a longer one, at any moment.
            if not any(has_changed(shards[0].folder, shards[0].manifest) for shards in opened.values() if shards):
                raise


def has_changed(folder: Path, manifest: Manifest) -> bool:
    """Return whether a dataset has another manifest by now: it is being extended."""
    try:
        return Manifest.load(folder).digest() != manifest.digest()
    except UserError:
        return False


def _opened(patterns: Sequence[str | Path], verify: bool, opened: dict[Path, list[Shard]]) -> ShardPool:
    found = [shard for pattern in patterns for path in _matches(str(pattern)) for shard in _shards(path, opened)]
    # By content: a copy of a shard under another name is the same shard; the one named first counts.
    once = {(shard.entry.files[steps_file(shard.entry.name)], shard.entry.first_block): shard for shard in found[::-1]}
    if not once:
        named = " ".join(map(str, patterns))
        raise UserError(f"{named}: the dataset has no finished shard yet; run the command that makes it again")
    return _pool(list(once.values()), verify)


def _matches(pattern: str) -> list[Path]:
    path = Path(pattern).expanduser()
    if path.exists():
        return [path]
    root = Path(path.anchor) if path.is_absolute() else Path()
    matches = sorted(root.glob(str(path.relative_to(path.anchor) if path.is_absolute() else path)))
    if not matches:
        raise UserError(f"{pattern}: no such folder or file; expected a dataset folder, a shard or a glob")
    return matches


def _shards(path: Path, opened: dict[Path, list[Shard]]) -> list[Shard]:
    """Return the shards that a folder or file is; those of a dataset that was opened before are in `opened`."""
    if path.is_file():
        folder = path.absolute().parent.parent
    elif path.absolute().name == "shards" and not (path / MANIFEST_NAME).is_file():
        folder = path.absolute().parent
    else:
        folder = path
    key = folder.resolve()
    if key not in opened:
        opened[key] = Shard.all_of(folder)
    if path.is_dir():
        return opened[key]
    inside = f"{path.absolute().parent.name}/{path.name}"
    listed = [shard for shard in opened[key] if steps_file(shard.entry.name) == inside]
    if not listed:
        raise UserError(f"{path}: not a shard of {folder}: its manifest does not list {inside} as a steps table")
    return listed


def _pool(shards: list[Shard], verify: bool) -> ShardPool:
    shards = sorted(
        shards, key=lambda each: (each.manifest.seed, each.entry.first_block, sorted(each.entry.files.values()))
    )
    _check_agreement(shards)
    with ThreadPoolExecutor(HASHING_THREADS) as executor:
        list(executor.map(lambda shard: shard.check(shard.steps, verify), shards))
    footers = {shard.steps: shard.footer() for shard in shards}
    # They are a few megabytes at most, and their files go when the dataset is extended while they are read.
    contents = {shard.steps: shard.content() for shard in shards if shard.may_grow}
    manifest = shards[0].manifest
    whole = len(shards) == len(manifest.shards) and len({id(shard.manifest) for shard in shards}) == 1
    digests = "".join(shard.entry.files[steps_file(shard.entry.name)] for shard in shards)
    return ShardPool(
        blocks=tuple(ref for shard in shards for ref in shard.blocks(footers[shard.steps])),
        task=manifest.task,
        image_shape=manifest.image_shape,
        action=manifest.action,
        discount=manifest.discount,
        object_set=manifest.object_set,
        manifest_digest=manifest.digest() if whole else hashlib.sha256(digests.encode()).hexdigest(),
        _footers=footers,
        _contents=contents,
    )


def _check_agreement(shards: list[Shard]) -> None:
    first, *others = {shard.folder: shard for shard in shards}.values()
    for other in others:
        theirs = _agreed(other.manifest)
        for what, ours in _agreed(first.manifest).items():
            if ours != theirs[what]:
                raise UserError(
                    f"cannot mix {what}: {first.folder} has {_shown(ours, theirs[what])}, "
                    f"{other.folder} has {_shown(theirs[what], ours)}; train on one of them"
                )


def _agreed(manifest: Manifest) -> dict[str, Any]:
    """Return what datasets must have in common to be trained on together."""
    return {
        "tasks": manifest.task_name,
        "simulator versions": manifest.task.get("simulator_version"),
        "task settings": manifest.task,
        "image shapes": manifest.image_shape,
        "action limits": manifest.action.limits,
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
