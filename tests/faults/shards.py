"""Shards that are missing, doubled, swapped, cut, empty, of another dataset or format, and datasets that do not mix."""

import json
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

from graspq.datasets.manifest import MANIFEST_NAME
from tests.faults.bits import TRAINING
from tests.faults.harness import HERE, Fault, Ran, Tried, Work, digest_of

DATA = Path("data/regular-24")
VERIFY = f"grasp-data verify {DATA} --workers 0"
TRAIN = f"grasp-train --algo mc --shards {{}} --out fresh --steps 1 {TRAINING}"
COLLECT = f"{HERE / 'small_dataset.py'} 24 {DATA} {DATA / 'objects'}"
TABLES = ("shards", "episodes")


def shards_of(case: Path, table: str) -> list[Path]:
    """Return the files of a table, in order."""
    return sorted((case / DATA / table).glob("*.parquet"))


def _missing(case: Path, table: str) -> str:
    shards_of(case, table)[1].unlink()
    return shards_of(case, table)[0].parent.name


def _swapped(case: Path, table: str) -> str:
    first, second = shards_of(case, table)[:2]
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)
    return table


def _cut(length: Callable[[int], int]) -> Callable[[Path, str], str]:
    def cut(case: Path, table: str) -> str:
        path = shards_of(case, table)[1]
        content = path.read_bytes()
        path.write_bytes(content[: length(len(content))])
        return path.name

    return cut


def _longer(case: Path, table: str) -> str:
    path = shards_of(case, table)[1]
    path.write_bytes(path.read_bytes() + b"\0")
    return path.name


def _folder(case: Path, table: str) -> str:
    path = shards_of(case, table)[1]
    path.unlink()
    path.mkdir()
    return path.name


def _other_content(case: Path, table: str) -> str:
    """Put a shard of the same name and seed, but of other objects, in the place of ours."""
    path = shards_of(case, table)[1]
    shutil.copyfile(case / "other" / path.parent.name / path.name, path)
    return path.name


def _older(case: Path, table: str) -> str:
    """Let the manifest say that the tables are of format 1."""
    path = case / DATA / MANIFEST_NAME
    values = json.loads(path.read_text()) | {"format_version": 1}
    _signed(path, values)
    return TABLES[0]


def _unknown_format(case: Path, table: str) -> str:
    path = case / DATA / MANIFEST_NAME
    _signed(path, json.loads(path.read_text()) | {"format_version": 99})
    return MANIFEST_NAME


def _doubled_entry(case: Path, table: str) -> str:
    path = case / DATA / MANIFEST_NAME
    values = json.loads(path.read_text())
    values["shards"].insert(1, values["shards"][0])
    _signed(path, values)
    return MANIFEST_NAME


def _signed(path: Path, values: dict[str, object]) -> None:
    from graspq.datasets.manifest import _digest_of

    content = {name: value for name, value in values.items() if name != "digest"}
    path.write_text(json.dumps({**content, "digest": _digest_of(content)}, indent=2, ensure_ascii=False) + "\n")


DAMAGES: dict[str, Callable[[Path, str], str]] = {
    "missing": _missing,
    "swapped": _swapped,
    "without its last byte": _cut(lambda length: length - 1),
    "cut in half": _cut(lambda length: length // 2),
    "of length 0": _cut(lambda length: 0),
    "a byte too long": _longer,
    "a folder": _folder,
    "of the same name with other content": _other_content,
    "said to be of format 1": _older,
    "said to be of format 99": _unknown_format,
    "listed twice": _doubled_entry,
}


def _change(name: str, value: object) -> Callable[[Path], None]:
    """Return what makes a dataset one that must not be mixed with another: its manifest says something else."""

    def change(folder: Path) -> None:
        path = folder / MANIFEST_NAME
        values = json.loads(path.read_text())
        place, *keys = name.split(".")
        if keys:
            values[place][keys[0]] = value
        else:
            values[place] = value
        # Its first shard alone, so that it is no copy.
        _signed(path, values)

    return change


UNMIXABLE: dict[str, Callable[[Path], None]] = {
    "task": _change("task.name", "targeted"),
    "task's settings": _change("task.home_height", 0.3),
    "simulator": _change("task.simulator_version", 1),
    "discount": _change("discount", 0.9),
    "object set": _change("object_set.sha256", "0" * 64),
    "split": _change("settings.split", "test"),
}


class Shards:
    """The kind."""

    name = "shard"

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return all; in the short form three, found by `grasp-data verify`."""
        for damage in list(DAMAGES)[: 3 if short else None]:
            for table in TABLES[: 1 if short else 2]:
                yield Fault(self.name, "grasp-data verify", f"{damage}, {table}")
        if short:
            return
        for damage in DAMAGES:
            for table in TABLES:
                if "format" not in damage and damage != "listed twice":
                    yield Fault(self.name, "grasp-datagen", f"{damage}, {table}")
            yield Fault(self.name, "grasp-train", f"{damage}, shards")
        for what in UNMIXABLE:
            yield Fault(self.name, "grasp-train", f"mixed {what}")
        for what in ("named twice", "copied under another name", "a subset by a glob"):
            yield Fault(self.name, "grasp-train", what)

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Damage a copy and run the command."""
        with work.copy("dataset") as case:
            if fault.name.startswith("mixed "):
                return self._mixed(fault.name.removeprefix("mixed "), case, work)
            damage, _, table = fault.name.rpartition(", ")
            if damage not in DAMAGES:
                return self._same(fault.name, case, work)
            whole = digest_of(case / DATA, (".lock",))
            if "other content" in damage:
                self._other(case, work)
            named = DAMAGES[damage](case, table)
            if fault.command == "grasp-data verify":
                return work.forked(VERIFY.split(), case).refused(named)
            if fault.command == "grasp-train":
                return work.forked(TRAIN.format(DATA).split(), case).refused(named, DATA.name)
            return self._made_again(case, work, whole)

    def _other(self, case: Path, work: Work) -> None:
        shutil.copytree(work.made("other"), case / "other")

    def _made_again(self, case: Path, work: Work, whole: dict[str, str]) -> Tried:
        """Let the command that made the dataset make it again: it must refuse, or the bytes are the same."""
        ran = work.forked(COLLECT.split(), case)
        broken = ran.broken()
        if broken is not None:
            return broken
        if ran.rc != 0:
            return ran.refused(DATA.name)
        now = digest_of(case / DATA, (".lock",))
        differing = [name for name in {**whole, **now} if whole.get(name) != now.get(name)]
        return Tried("silently wrong", str(differing)) if differing else Tried("survived", "made again, the same bytes")

    def _mixed(self, what: str, case: Path, work: Work) -> Tried:
        other = case / "data" / "other"
        self._other(case, work)
        (case / "other").rename(other)
        UNMIXABLE[what](other)
        return work.forked(TRAIN.format(f"{DATA} {other.relative_to(case)}").split(), case).refused("cannot mix")

    def _same(self, what: str, case: Path, work: Work) -> Tried:
        """Name the same shards in another way: the weights must be those of naming them once."""
        first = _weights(work.forked(TRAIN.format(DATA).split(), case), case)
        shutil.copytree(case / DATA, case / "data" / "copy")
        named = {
            "named twice": f"{DATA} {DATA}",
            "copied under another name": f"{DATA} data/copy",
            "a subset by a glob": f"{DATA}/shards/*.parquet",
        }[what]
        second = _weights(work.forked(TRAIN.format(named).split(), case), case)
        if first is None or first != second:
            return Tried("silently wrong", f"{what}: other weights")
        return Tried("survived", "the same weights")


def _weights(ran: Ran, case: Path) -> dict[str, str] | None:
    if ran.rc != 0:
        return None
    found = {name: digest for name, digest in digest_of(case / "fresh").items() if name.endswith("safetensors")}
    shutil.rmtree(case / "fresh")
    return found
