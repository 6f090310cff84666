"""The manifest of a dataset: what it was made with and which shards exist, with the SHA-256 of every file.

What is not in the manifest does not exist. It carries its own digest, and holds no times, hosts or worker counts.
"""

import dataclasses
import hashlib
import json
import re
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from graspq.common.action_space import ActionSpace, grasping
from graspq.common.errors import UserError, refuse_other, said_of
from graspq.common.files import read_json, write_json

FORMAT_VERSION = 2
READABLE = (1, 2)
MOST = 10**15  # of anything that is counted
LARGEST_IMAGE = 4096
MANIFEST_NAME = "manifest.json"
SHARD_NAME = re.compile(r"blocks-\d{6,}-\d{6,}(-short-\d+)?")
DECIDING = ("format_version", "task", "settings", "object_set", "discount", "versions")
REMEDY = "copy the dataset again, or make it again with the command that made it"


def shard_name(first_block: int, blocks: int, episodes: int, block_size: int) -> str:
    """Return a shard's name, `blocks-<first>-<last>`; with a short last block also the number of its episodes.

    A short shard that is extended thereby gets a new name, and never replaces a file that the manifest still lists.
    """
    name = f"blocks-{first_block:06d}-{first_block + blocks - 1:06d}"
    return name if episodes == blocks * block_size else f"{name}-short-{episodes}"


def steps_file(name: str) -> str:
    """Return the path of a shard's steps table within its dataset."""
    return f"shards/{name}.parquet"


def episodes_file(name: str) -> str:
    """Return the path of a shard's episodes table within its dataset."""
    return f"episodes/{name}.parquet"


@dataclass(frozen=True)
class ShardEntry:
    """One committed shard.

    Attributes:
        name: see `shard_name`.
        first_block: number of its first block.
        blocks: number of its blocks, which is the number of row groups of its steps table.
        episodes: number of its episodes.
        rows: number of its steps.
        successes: number of its successful episodes.
        seeds: seeds of its first and last episode.
        files: path within the dataset → SHA-256.
        sizes: path within the dataset → bytes.
    """

    name: str
    first_block: int
    blocks: int
    episodes: int
    rows: int
    successes: int
    seeds: tuple[int, int]
    files: dict[str, str]
    sizes: dict[str, int]

    def __post_init__(self) -> None:
        expected = {steps_file(self.name), episodes_file(self.name)}
        if SHARD_NAME.fullmatch(self.name) is None or set(self.files) != expected or set(self.sizes) != expected:
            raise ValueError(f"shard {self.name!r}: expected the files {sorted(expected)}")
        if not all(isinstance(digest, str) for digest in self.files.values()):
            raise ValueError(f"shard {self.name}: expected a SHA-256 for each file, got {self.files}")
        counts = (self.first_block, self.blocks, self.episodes, self.rows, self.successes, *self.sizes.values())
        if not all(type(count) is int and 0 <= count <= MOST for count in counts):
            raise ValueError(f"shard {self.name}: expected whole numbers of 0 to {MOST:.0e}, got {counts}")
        if len(self.seeds) != 2 or not all(type(seed) is int for seed in self.seeds):
            raise ValueError(f"shard {self.name}: expected two seeds, got {self.seeds}")
        # A block takes bytes in the footer of its file, so that no more of them are believed in than can be there.
        if not 1 <= self.blocks <= min(self.episodes, self.sizes[steps_file(self.name)]) or self.rows < self.episodes:
            raise ValueError(f"shard {self.name}: {self.blocks} blocks of {self.episodes} episodes, {self.rows} rows")

    @property
    def bytes(self) -> int:
        """Bytes of its files together."""
        return sum(self.sizes.values())

    @property
    def block_range(self) -> range:
        """Numbers of its blocks."""
        return range(self.first_block, self.first_block + self.blocks)


@dataclass(frozen=True)
class Manifest:
    """A dataset's description and its shards.

    Attributes:
        task: the task's settings as JSON; `task["name"]` is its name.
        settings: the collection's settings as JSON, all that determines the bytes; `"block_size"` is read here.
        versions: package → version, of what can change the bytes.
        object_set: `name` and `sha256`, the digest of `objects/object_set.json`.
        image_shape: (H, W, 3).
        action: what an action means.
        discount: γ of the stored `mc_return`.
        phi_range: least and greatest unwrapped wrist angle φ, radians; None where a pose has none.
        shards: ordered by first block, disjoint.
        files: SHA-256 of the other files that belong to it, such as `README.md`.
        format_version: that of its tables, see `columns`; new ones are of format 2.
        tells_action: whether the JSON holds `action`; a manifest that was read without it is written without it.
    """

    task: dict[str, Any]
    settings: dict[str, Any]
    versions: dict[str, str]
    object_set: dict[str, Any]
    image_shape: tuple[int, int, int]
    action: ActionSpace
    discount: float
    phi_range: tuple[float, float] | None = None
    shards: tuple[ShardEntry, ...] = ()
    files: dict[str, str] = field(default_factory=dict)
    format_version: int = FORMAT_VERSION
    tells_action: bool = True

    def __post_init__(self) -> None:
        _check_kinds(self)
        following = 0
        for entry in self.shards:
            if entry.first_block < following:
                raise ValueError(f"shard {entry.name}: its blocks overlap or are out of order")
            following = entry.first_block + entry.blocks

    @property
    def block_size(self) -> int:
        """Episodes of a whole block."""
        return int(self.settings["block_size"])

    @property
    def seed(self) -> str:
        """Seed of the dataset."""
        return str(self.settings.get("seed", ""))

    @property
    def episodes(self) -> int:
        """Number of episodes in all shards."""
        return sum(entry.episodes for entry in self.shards)

    @property
    def rows(self) -> int:
        """Number of steps in all shards."""
        return sum(entry.rows for entry in self.shards)

    @property
    def successes(self) -> int:
        """Number of successful episodes in all shards."""
        return sum(entry.successes for entry in self.shards)

    @property
    def bytes(self) -> int:
        """Bytes of all shards' files."""
        return sum(entry.bytes for entry in self.shards)

    @property
    def task_name(self) -> str:
        """Name of the task."""
        return str(self.task["name"])

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values, without the digest."""
        values = {name.name: getattr(self, name.name) for name in dataclasses.fields(self)}
        if not values.pop("tells_action"):
            limits = {"action": ("action_limits", list(self.action.limits))}
            values = dict(limits.get(name, (name, value)) for name, value in values.items())
        else:
            values["action"] = self.action.to_json()
        values["shards"] = [dataclasses.asdict(entry) for entry in self.shards]
        ordered = {"format_version": values.pop("format_version")} | values
        result: dict[str, Any] = json.loads(json.dumps(ordered, allow_nan=False))
        return result

    def digest(self) -> str:
        """Return the SHA-256 of the manifest's content, 64 hexadecimal digits."""
        return _digest_of(self.to_json())

    def save(self, folder: Path) -> None:
        """Write `manifest.json` atomically and durably; the same manifest gives the same bytes."""
        values = self.to_json()
        write_json(folder / MANIFEST_NAME, {**values, "digest": _digest_of(values)})

    @classmethod
    def load(cls, folder: Path) -> "Manifest":
        """Return the manifest of the dataset in `folder`.

        Raises:
            UserError: there is none, it is damaged, or it is of another format version.
        """
        path = folder / MANIFEST_NAME
        if not folder.is_dir():
            raise UserError(f"{folder}: no such dataset folder; make one with `make data` or `grasp-datagen`")
        if not path.is_file():
            raise UserError(
                f"{folder}: not a dataset, it has no {MANIFEST_NAME}; expected a folder that `make data` made"
            )
        values = read_json(path, "dataset manifest")
        if not isinstance(values, dict) or "format_version" not in values:
            raise UserError(f"{path}: not a dataset manifest; {REMEDY}")
        try:
            with said_of(path):
                return cls._checked(path, values)
        except UserError:
            raise
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
            raise UserError(f"{path}: not a dataset manifest of this version ({error}); {REMEDY}") from None

    @classmethod
    def _checked(cls, path: Path, values: dict[str, Any]) -> "Manifest":
        if values["format_version"] not in READABLE and values.get("digest") == _digest_of(values):
            found, expected = values["format_version"], " or ".join(map(str, READABLE))
            raise UserError(f"{path}: format version {found}, expected {expected}; use another graspq")
        # The bytes are compared, not only the content, so that no flipped bit passes, not even one in white space.
        rendered = json.dumps(values, indent=2, ensure_ascii=False, allow_nan=True) + "\n"
        if values.get("digest") != _digest_of(values) or path.read_bytes() != rendered.encode():
            raise UserError(f"{path}: damaged or edited, its content does not match its own digest; {REMEDY}")
        return cls.from_json({name: value for name, value in values.items() if name != "digest"})

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "Manifest":
        """Return the manifest that `to_json` wrote.

        Raises:
            KeyError, TypeError, ValueError: the values are not those of a manifest.
        """
        values = dict(values)
        tells_action = "action" in values
        action = ActionSpace.from_json(values.pop("action")) if tells_action else grasping(values.pop("action_limits"))
        shards = tuple(ShardEntry(**{**entry, "seeds": tuple(entry["seeds"])}) for entry in values.pop("shards"))
        image_shape, phi_range = tuple(values.pop("image_shape")), values.pop("phi_range")
        return cls(
            **values,
            image_shape=image_shape,
            action=action,
            phi_range=None if phi_range is None else tuple(phi_range),
            shards=shards,
            tells_action=tells_action,
        )

    def with_shard(self, entry: ShardEntry) -> "Manifest":
        """Return the manifest with `entry` added; it takes the place of one that starts at the same block.

        The dataset card is of the dataset as it was: it is listed again when it is written again.
        """
        others = [other for other in self.shards if other.first_block != entry.first_block]
        shards = sorted([*others, entry], key=lambda shard: shard.first_block)
        return dataclasses.replace(self, shards=tuple(shards), files={})


def _check_kinds(manifest: Manifest) -> None:
    """Refuse what no command writes, before anything is allocated or opened by it.

    Raises:
        ValueError: naming the first entry that is not as expected.
    """
    task, settings, shape, limits = manifest.task, manifest.settings, manifest.image_shape, manifest.phi_range
    dicts = (task, settings, manifest.versions, manifest.object_set, manifest.files)
    expected = {
        "objects for task, settings, versions, object_set and files": all(isinstance(one, dict) for one in dicts),
        "a name of the task": isinstance(task, dict) and isinstance(task.get("name"), str),
        "max_steps of 1 to 10,000": isinstance(task, dict) and _whole(task.get("max_steps"), 1, 10_000),
        "a block_size of 1 to 100,000": isinstance(settings, dict) and _whole(settings.get("block_size"), 1, 100_000),
        "no blocks_per_shard, or 0 to 100,000": isinstance(settings, dict)
        and _whole(settings.get("blocks_per_shard", 0), 0, 100_000),
        "a name and a sha256 of the object_set": isinstance(manifest.object_set, dict)
        and all(isinstance(manifest.object_set.get(name), str) for name in ("name", "sha256")),
        f"an image_shape of three, each 1 to {LARGEST_IMAGE}": len(shape) == 3
        and all(_whole(size, 1, LARGEST_IMAGE) for size in shape),
        "a discount of 0 to 1": isinstance(manifest.discount, int | float) and 0 <= manifest.discount <= 1,
        "no phi_range, or two numbers": limits is None
        or (len(limits) == 2 and all(isinstance(one, int | float) for one in limits)),
        "files inside the dataset with their digests": isinstance(manifest.files, dict)
        and all(_inside(path) and isinstance(digest, str) for path, digest in manifest.files.items()),
    }
    wrong = next((what for what, right in expected.items() if not right), None)
    if wrong is not None:
        raise ValueError(f"expected {wrong}")


def _whole(value: Any, least: int, most: int) -> bool:
    return type(value) is int and least <= value <= most


def _inside(path: str) -> bool:
    parts = PurePosixPath(path)
    return not parts.is_absolute() and ".." not in parts.parts and "\0" not in path


def require_same(folder: Path, existing: Manifest, fresh: Manifest, way_out: str) -> None:
    """Refuse to add to a dataset that was made otherwise; see `refuse_other`."""
    theirs, ours = ({name: getattr(one, name) for name in DECIDING} for one in (existing, fresh))
    refuse_other(folder, "grasps made", theirs, ours, way_out)


def _digest_of(values: dict[str, Any]) -> str:
    content = {name: value for name, value in values.items() if name != "digest"}
    rendered = json.dumps(content, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return hashlib.sha256(rendered.encode()).hexdigest()
