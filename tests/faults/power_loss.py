"""The power fails: what was not synced may be lost, and a disk may keep any part of it.

A run's system calls are noted, then replayed into a model of a disk that is cut after any of them. POSIX promises no
more than this: the bytes of a file are there that an fsync of the file has followed; a name is there, or gone, where an
fsync of its folder has followed. All else is kept or lost, folder by folder in the order it was done, file by file.
"""

import random
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from tests.faults.crash_points import few, gone_on, stage_of
from tests.faults.harness import Fault, Tried, Work
from tests.faults.system_calls import (
    CREATE,
    FSYNC,
    LINK,
    MKDIR,
    OF_COMMAND,
    REMOVE,
    RENAME,
    TRAINS,
    TRUNCATE,
    WRITE,
    Call,
    Scenario,
    Stage,
    compared,
    scenarios,
)

LOST, KEPT, MIXED = "all that was not synced is lost", "names are kept, bytes are lost", "a part is lost"
WAYS = (LOST, KEPT, MIXED)
MOST = 28  # of each way and command, evenly spread over the calls


@dataclass
class File:
    """A file: its bytes, those that are on the disk, and what was done to them since, in order.

    A step is a place and the bytes that were written there, or a new length and None.
    """

    content: bytes = b""
    synced: bytes = b""
    since: list[tuple[int, bytes | None]] = field(default_factory=list)

    def change(self, place: int, data: bytes | None) -> None:
        """Write bytes, or set the length."""
        self.since.append((place, data))
        self.content = _changed(self.content, place, data)

    def sync(self) -> None:
        """Put all bytes on the disk."""
        self.synced, self.since = self.content, []

    def left(self, draws: random.Random) -> bytes:
        """Return the bytes that are there when a part of what was done since the last sync is lost."""
        if not self.since:
            return self.synced
        content = self.synced
        whole = draws.randint(0, len(self.since))
        for step in self.since[:whole]:
            content = _changed(content, *step)
        for place, data in self.since[whole : whole + 1]:
            if data is not None and draws.random() < 0.5:  # the next write is torn
                content = _changed(content, place, data[: draws.randint(0, len(data))])
        # A disk may also have kept the new length, and not the bytes.
        return content.ljust(len(self.content), b"\0") if draws.random() < 0.3 else content


def _changed(content: bytes, place: int, data: bytes | None) -> bytes:
    padded = content.ljust(place, b"\0")
    return padded[:place] if data is None else padded[:place] + data + padded[place + len(data) :]


@dataclass
class Folder:
    """A folder: its names, those that are on the disk, and what was done to them since, in order."""

    names: dict[str, "File | Folder"] = field(default_factory=dict)
    synced: dict[str, "File | Folder"] = field(default_factory=dict)
    since: list[dict[str, "File | Folder | None"]] = field(default_factory=list)

    def change(self, changes: dict[str, "File | Folder | None"]) -> None:
        """Set names, or remove them (None), in one step."""
        self.since.append(changes)
        _apply(self.names, changes)

    def sync(self) -> None:
        """Put all names on the disk."""
        self.synced, self.since = dict(self.names), []


def _apply(names: dict[str, File | Folder], changes: dict[str, File | Folder | None]) -> None:
    for name, what in changes.items():
        if what is None:
            names.pop(name, None)
        else:
            names[name] = what


class Disk:
    """A model of a disk, which begins with a folder that is all on it."""

    def __init__(self, start: Path) -> None:
        self.root = _on_disk(start)

    def do(self, call: Call) -> None:
        """Replay one call."""
        if call.failed or call.path.endswith(" (deleted)"):
            return
        above, name = self._place(call.path)
        what = self.found(call.path)
        if call.what == CREATE:
            if call.place == 0:
                above.change({name: File()})
            elif call.place == 2 and isinstance(what, File):
                what.change(0, None)
        elif call.what == MKDIR:
            above.change({name: Folder()})
        elif call.what == WRITE:
            assert isinstance(what, File), call.path
            what.change(call.place, call.data)
        elif call.what == TRUNCATE:
            assert isinstance(what, File), call.path
            what.change(call.place, None)
        elif call.what == FSYNC:
            if what is not None:
                what.sync()
        elif call.what in (RENAME, LINK):
            there, new = self._place(call.other)
            moved = {name: None} if call.what == RENAME else {}
            if there is above:
                above.change({**moved, new: what})
            else:
                there.change({new: what})
                above.change(moved)
        elif call.what == REMOVE:
            above.change({name: None})

    def found(self, path: str) -> "File | Folder | None":
        here: File | Folder | None = self.root
        for part in Path(path).parts:
            here = here.names.get(part) if isinstance(here, Folder) else None
        return here

    def _place(self, path: str) -> tuple[Folder, str]:
        above = self.found(str(Path(path).parent))
        assert isinstance(above, Folder), path
        return above, Path(path).name

    def left(self, way: str, draws: random.Random) -> Folder:
        """Return what is there when the power is back."""
        return _left(self.root, way, draws)


def _on_disk(path: Path) -> Folder:
    names: dict[str, File | Folder] = {}
    for entry in path.iterdir():
        names[entry.name] = _on_disk(entry) if entry.is_dir() else File(entry.read_bytes(), entry.read_bytes())
    return Folder(dict(names), dict(names))


def _left(folder: Folder, way: str, draws: random.Random) -> Folder:
    names = dict(folder.synced)
    kept = {LOST: 0, KEPT: len(folder.since), MIXED: draws.randint(0, len(folder.since))}[way]
    for changes in folder.since[:kept]:
        _apply(names, changes)
    left = Folder()
    for name, what in sorted(names.items()):
        if isinstance(what, Folder):
            left.names[name] = _left(what, way, draws)
        else:
            left.names[name] = File(what.left(draws) if way == MIXED else what.synced)
    return left


def write_out(folder: Folder, path: Path) -> None:
    """Write what is left into a folder that is there."""
    for name, what in folder.names.items():
        if isinstance(what, Folder):
            (path / name).mkdir()
            write_out(what, path / name)
        else:
            (path / name).write_bytes(what.content)


def files_of(folder: Folder, above: str = "") -> Iterator[tuple[str, bytes]]:
    """Yield the path and the bytes of all files."""
    for name, what in folder.names.items():
        if isinstance(what, Folder):
            yield from files_of(what, f"{above}{name}/")
        else:
            yield f"{above}{name}", what.content


class Committed:
    """What the program took for committed, path -> bytes, as calls are replayed.

    That is what was given its name by a rename, after which the folder of the name was synced.
    """

    def __init__(self, disk: Disk) -> None:
        self._disk = disk
        self._waiting: dict[str, bytes | dict[str, bytes]] = {}
        self.files: dict[str, bytes] = {}

    def see(self, call: Call) -> None:
        """Take notice of a call that was replayed."""
        if call.failed or call.what not in (RENAME, REMOVE, FSYNC):
            return
        if call.what == FSYNC:
            for path in [path for path in self._waiting if str(Path(path).parent) == (call.path or ".")]:
                content = self._waiting.pop(path)
                self.files |= {path: content} if isinstance(content, bytes) else content
            return
        self._forget(call.path)
        if call.what == RENAME:
            self._forget(call.other)  # until the folder is synced, the disk may have the old one or the new one
            what = self._disk.found(call.other)
            if isinstance(what, File):
                self._waiting[call.other] = what.content
            elif what is not None:
                self._waiting[call.other] = dict(files_of(what, f"{call.other}/"))

    def _forget(self, gone: str) -> None:
        """Drop what is known of a path, and of what lies below it."""
        for known in (self._waiting, self.files):
            for path in [path for path in known if path == gone or path.startswith(f"{gone}/")]:
                del known[path]

    def missing(self, left: Folder) -> str | None:
        """Return what is not there; a file that has grown since may have lost what it has grown by."""
        now = dict(files_of(left))
        return next((path for path, content in self.files.items() if not now.get(path, b"").startswith(content)), None)


@dataclass
class PowerLoss:
    """Cut after any call, in one of three ways."""

    name: str = "power loss"

    def faults(self, work: Work, short: bool) -> Iterable[Fault]:
        """Return some cuts for each command and way; after the last call always."""
        for scenario in scenarios(work, short, TRAINS):
            last = len(stage_of(work).unbroken(scenario).changes)
            for way in (LOST, MIXED) if short else WAYS:
                numbers = [] if short else few(range(1, last + 1), MOST)
                for number in dict.fromkeys([*numbers, last]):
                    yield Fault(self.name, scenario.command, f"after call {number}, {way}")

    def tried(self, fault: Fault, work: Work) -> Tried:
        """Replay the run until the cut, look for what was committed, and run the command there."""
        stage, scenario = stage_of(work), OF_COMMAND[fault.command]
        number, way = int(fault.name.split()[2].rstrip(",")), fault.name.partition(", ")[2]
        calls = stage.unbroken(scenario).changes[:number]
        disk = Disk(stage.start(scenario))
        committed = Committed(disk)
        for call in calls:
            disk.do(call)
            committed.see(call)
        left = disk.left(way, random.Random(fault.name))
        gone = committed.missing(left)
        if gone is not None:
            return Tried("lost", f"{gone}: was committed")
        with work.copy() as case:
            write_out(left, case)
            done = len(calls) == len(stage.unbroken(scenario).changes)
            if done:
                gone = not_there(case, stage, scenario)
                if gone is not None:
                    return Tried("lost", f"{gone}: not there after the command had ended well")
            return gone_on(scenario, case, work)


def not_there(case: Path, stage: Stage, scenario: Scenario) -> str | None:
    """Return a file that the command had left when it ended, and that is not there or another."""
    found = compared(case)
    for name, digest in stage.unbroken(scenario).files.items():
        if found.get(name) != digest:
            return name
    return None
